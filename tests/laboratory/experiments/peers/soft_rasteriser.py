"""Fits a head with a soft rasteriser and Adam: silhouettes that can be differentiated, for comparison with the contour
solver.

Liu, Li, Chen and Li, *Soft Rasterizer*, ICCV 2019: a pixel at distance d from a triangle is covered by it with the
probability ``sigmoid(+-d^2 / sigma^2)`` (plus inside), and by the mesh with ``1 - prod(1 - p)`` over its triangles. As
in PyTorch3D, pairs of pixels and triangles are looked up once a step, without derivatives, and only near the outline.
The probabilities and their derivatives are computed by JAX on the processor. The loss compares them with the area that
the input mask covers in every pixel; Adam minimises it with a shrinking sigma. Needs the dependency group ``peers``.
"""

# pyright: reportMissingImports=false
# The peers' packages are a dependency group of their own: `uv sync --group peers`.

from collections.abc import Callable, Mapping
from dataclasses import dataclass
from functools import cache
from typing import Any, Literal

import cv2
import numpy as np
from jaxtyping import Bool, Float, Float32, Int32

from pipeline.head_model.model import HeadModel
from pipeline.imaging.silhouette import Silhouette
from rig.geometry import Similarity
from rig.jit import njit
from rig.render.renderer import Renderer
from rig.rig import Rig

REACH = 3.0  # sigmas beyond which a triangle does not count: sigmoid(-9) is 1e-4
NOISE = 0.3  # of a pixel's coverage: what a unit of the prior is weighed against
MESH, IMAGE_SCALE = "p95", 0.5  # the paper's working level; its coarse one led away from a start this near
DECAY = (0.9, 0.999)  # Adam's


@dataclass(frozen=True, slots=True)
class Phase:
    """Holds a number of steps of Adam at one sigma (px of the reduced image), and their size (standard deviations)."""

    steps: int
    sigma_px: float
    rate: float


PHASES = (Phase(30, 1.0, 0.1), Phase(60, 0.5, 0.04), Phase(80, 0.25, 0.02))


@dataclass(frozen=True, slots=True, eq=False)
class Pairs:
    """Holds pixels near the outline, and the triangles near them; pairs are sorted by pixel."""

    pixel: Float32[np.ndarray, "p 2"]
    target: Float32[np.ndarray, " p"]  # coverage of the input
    row: Int32[np.ndarray, " n"]  # of the pair's pixel
    corner: Int32[np.ndarray, "n 3"]  # of the pair's triangle, in the screen points of all views


def fit_soft(
    model: HeadModel,
    world_from_head: Similarity,
    silhouettes: Mapping[str, Silhouette],
    rig: Rig,
    *,
    renderer: Renderer,
    modes: int = 60,
    phases: tuple[Phase, ...] = PHASES,
) -> tuple[Float[np.ndarray, " m"], int]:
    """Fits the head's coefficients at a given pose with Adam. Returns the coefficients (standard deviations), and the
    number of gradients that were computed."""
    scaled, faces = rig.scaled(IMAGE_SCALE), model.levels[MESH].faces
    coverage = np.stack([input_coverage(silhouettes[camera.name], IMAGE_SCALE) for camera in scaled])
    shape = shape_of(model, world_from_head, scaled, modes)
    coefficients, first, second = np.zeros((3, modes), np.float32)
    taken = 0
    with renderer.silhouette_set(scaled, faces) as drawn:
        for phase in phases:
            for _ in range(phase.steps):
                taken += 1
                masks = drawn.masks(world_from_head.apply(model.vertices(coefficients.astype(float), MESH)))
                screen = np.asarray(_compiled("screen")(coefficients, *shape))
                drawn_masks = np.stack([masks[camera.name] for camera in scaled])
                pairs = find_pairs(screen, faces, drawn_masks, coverage, REACH * phase.sigma_px)
                slope = np.asarray(_compiled("slope")(coefficients, *shape, *padded(pairs), phase.sigma_px))
                first = DECAY[0] * first + (1 - DECAY[0]) * slope
                second = DECAY[1] * second + (1 - DECAY[1]) * slope**2
                pull = first / (1 - DECAY[0] ** taken) / (np.sqrt(second / (1 - DECAY[1] ** taken)) + 1e-8)
                coefficients = (coefficients - phase.rate * pull).astype(np.float32)
    return coefficients.astype(float), taken


@cache
def _compiled(name: Literal["screen", "slope"]) -> Callable[..., Any]:
    import jax

    return jax.jit(screen_points if name == "screen" else jax.grad(loss))


def input_coverage(silhouette: Silhouette, scale: float) -> Float32[np.ndarray, "h w"]:
    """Returns the share of every pixel of the reduced image that the input covers."""
    height, width = silhouette.distance.shape
    soft = np.clip(0.5 - silhouette.distance, 0.0, 1.0)
    return cv2.resize(soft, (round(width * scale), round(height * scale)), interpolation=cv2.INTER_AREA)


def shape_of(model: HeadModel, world_from_head: Similarity, rig: Rig, modes: int) -> tuple[np.ndarray, ...]:
    """Returns the mean (V, 3) and modes (M, V, 3) in the world, and every camera (K, 21), as JAX takes them."""
    mean = world_from_head.apply((model.levels[MESH].operator @ model.mean).astype(float))
    turn = (world_from_head.scale * world_from_head.rotation).astype(np.float32)
    basis = np.einsum("ab,mvb->mva", turn, model.basis(MESH, modes), optimize=True)
    cameras = []
    for camera in rig:
        pose = camera.camera_from_world
        cameras.append([*pose.rotation.ravel(), *pose.translation, *camera.intrinsics.values()])
    return mean.astype(np.float32), basis.astype(np.float32), np.array(cameras, np.float32)


def screen_points(coefficients: Any, mean: Any, basis: Any, cameras: Any) -> Any:
    """Returns pixels (K * V, 2) of the vertices in all views."""
    import jax
    import jax.numpy as jnp

    points = mean + jnp.tensordot(coefficients, basis, axes=1)

    def view(p: Any) -> Any:
        local = points @ p[:9].reshape(3, 3).T + p[9:12]
        fx, fy, cx, cy, k1, k2, p1, p2, k3 = p[12:]
        x, y = local[:, 0] / local[:, 2], local[:, 1] / local[:, 2]
        r2 = x * x + y * y
        radial = 1 + r2 * (k1 + r2 * (k2 + r2 * k3))
        u = x * radial + 2 * p1 * x * y + p2 * (r2 + 2 * x * x)
        v = y * radial + p1 * (r2 + 2 * y * y) + 2 * p2 * x * y
        return jnp.stack([fx * u + cx, fy * v + cy], axis=1)

    return jax.vmap(view)(cameras).reshape(-1, 2)


def loss(
    coefficients: Any, mean: Any, basis: Any, cameras: Any, pixel: Any, target: Any, weight: Any, row: Any, corner: Any,
    present: Any, sigma: Any,
) -> Any:  # fmt: skip
    """Returns the squared difference of soft and input coverage in units of ``NOISE``, plus the prior: z ~ N(0, I)."""
    import jax.numpy as jnp
    from jax.ops import segment_sum

    triangles = screen_points(coefficients, mean, basis, cameras)[corner]
    exponent = signed_square(triangles, pixel[row]) / sigma**2
    free = segment_sum(-present * jnp.logaddexp(exponent, 0.0), row, len(pixel), indices_are_sorted=True)
    miss = weight * (1.0 - jnp.exp(free) - target)
    return 0.5 * (miss**2).sum() / NOISE**2 + 0.5 * (coefficients**2).sum()


def signed_square(triangles: Any, points: Any) -> Any:
    """Returns the squared distance of points (n, 2) to the border of triangles (n, 3, 2), positive inside."""
    import jax.numpy as jnp

    squares, sides = [], []
    for a, b in ((0, 1), (1, 2), (2, 0)):
        start, edge, to = triangles[:, a], triangles[:, b] - triangles[:, a], points - triangles[:, a]
        along = jnp.clip((to * edge).sum(1) / jnp.maximum((edge * edge).sum(1), 1e-12), 0.0, 1.0)
        squares.append(((points - start - along[:, None] * edge) ** 2).sum(1))
        sides.append(edge[:, 0] * to[:, 1] - edge[:, 1] * to[:, 0])
    nearest = jnp.minimum(jnp.minimum(squares[0], squares[1]), squares[2])
    inside = ((sides[0] > 0) == (sides[1] > 0)) & ((sides[1] > 0) == (sides[2] > 0))
    return jnp.where(inside, nearest, -nearest)


def find_pairs(
    screen: Float32[np.ndarray, "kv 2"],
    faces: np.ndarray,
    masks: Bool[np.ndarray, "k h w"],
    coverage: Float32[np.ndarray, "k h w"],
    reach_px: float,
) -> Pairs:
    """Returns pixels within ``reach_px`` of the model's outline, and the triangles within that of each."""
    near = np.stack([_near_outline(mask, reach_px) for mask in masks])
    index = np.full(near.shape, -1, np.int32)
    index[near] = np.arange(near.sum(), dtype=np.int32)
    points = screen.reshape(len(masks), -1, 2)
    row, corner = _search(points, np.ascontiguousarray(faces, np.int32), index, np.float32(reach_px))
    order = np.argsort(row, kind="stable")
    view, v, u = np.nonzero(near)
    return Pairs(np.stack([u, v], 1).astype(np.float32), coverage[view, v, u], row[order], corner[order])


def _near_outline(mask: Bool[np.ndarray, "h w"], reach_px: float) -> Bool[np.ndarray, "h w"]:
    """Within a reach of the other kind of pixel."""
    size = 2 * int(np.ceil(reach_px)) + 1
    disk = cv2.getStructuringElement(cv2.MORPH_ELLIPSE, (size, size))
    drawn = mask.view(np.uint8)
    return cv2.dilate(drawn, disk) != cv2.erode(drawn, disk)


@njit(cache=True)
def _search(points, faces, index, reach):
    """Two passes: count, then fill. Row of the pixel, and the triangle's corners in all views' points."""
    views, height, width = index.shape
    count = 0
    rows, corners = np.empty(0, np.int32), np.empty((0, 3), np.int32)
    for fill in range(2):
        if fill:
            rows, corners = np.empty(count, np.int32), np.empty((count, 3), np.int32)
        count = 0
        for k in range(views):
            for f in range(len(faces)):
                a, b, c = points[k, faces[f, 0]], points[k, faces[f, 1]], points[k, faces[f, 2]]
                left = max(0, int(np.ceil(min(a[0], b[0], c[0]) - reach)))
                right = min(width - 1, int(np.floor(max(a[0], b[0], c[0]) + reach)))
                top = max(0, int(np.ceil(min(a[1], b[1], c[1]) - reach)))
                bottom = min(height - 1, int(np.floor(max(a[1], b[1], c[1]) + reach)))
                for y in range(top, bottom + 1):
                    for x in range(left, right + 1):
                        if index[k, y, x] < 0:
                            continue
                        if fill:
                            rows[count] = index[k, y, x]
                            for j in range(3):
                                corners[count, j] = k * points.shape[1] + faces[f, j]
                        count += 1
    return rows, corners


def padded(pairs: Pairs) -> tuple[np.ndarray, ...]:
    """Returns pixel, target, weight, row, corner and present, padded to one of a few sizes, since JAX compiles for each
    size."""
    pixels, count = len(pairs.pixel), len(pairs.row)
    more, spare = _capacity(pixels + 1) - pixels, _capacity(count) - count
    return (
        np.pad(pairs.pixel, ((0, more), (0, 0))),
        np.pad(pairs.target, (0, more)),
        np.pad(np.ones(pixels, np.float32), (0, more)),
        np.pad(pairs.row, (0, spare), constant_values=pixels + more - 1),
        np.pad(pairs.corner, ((0, spare), (0, 0))),
        np.pad(np.ones(count, np.float32), (0, spare)),
    )


def _capacity(count: int) -> int:
    """The next of 1, 1.5, 2, 3, 4, 6, 8 ..."""
    power = 1 << max(count - 1, 1).bit_length()
    return power * 3 // 4 if count <= power * 3 // 4 else power
