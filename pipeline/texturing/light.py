"""Estimates the light in which a head was photographed, from the shading of the head.

The light is given by spherical harmonics up to second order, nine coefficients for each channel. Spherical harmonics
describe 98 % of the shading of a matt surface in any distant light (Ramamoorthi and Hanrahan, *An Efficient
Representation for Irradiance Environment Maps*, SIGGRAPH 2001). The shading of a vertex leaves out light that the head
itself blocks (Sloan, Kautz and Snyder, *Precomputed Radiance Transfer*, SIGGRAPH 2002).

The skin of the face is assumed to have the same colour everywhere; brows, lips and beards are treated as outliers. A
dark head in bright light and a bright head in dim light look the same, so the light's mean over the sphere is fixed at
1 in each channel. Light from directions that no part of the face sees is estimated close to 1.
"""

from dataclasses import dataclass

import numpy as np
from jaxtyping import Bool, Float, Int

from pipeline.compute.threads import map_in_threads
from pipeline.geometry.projection import camera_depths, depth_map, project_points
from pipeline.texturing.neighbourhood import Neighbourhood
from rig.camera import Camera, Intrinsics
from rig.geometry import look_at
from rig.mesh import Mesh

HARMONICS = ("1", "y", "z", "x", "xy", "yz", "3z2-1", "xz", "x2-y2")  # the columns of ``harmonics``
BAND_FACTORS = np.repeat([1.0, 2.0 / 3.0, 0.25], [1, 3, 5])  # Ramamoorthi and Hanrahan, eq. (8), by pi: white is 1
DIRECTIONS = 96  # that shadows are looked for in: the face differs from 384 by 0.007 (rms) of white
MAP_PX = 192  # 2 mm a pixel
FAR_RADII = 20.0  # a distant light, at 3 degrees
BIAS_MM = 3.0  # a surface does not hide itself for its facets
SLOPE_PX, MIN_COSINE = 1.5, 0.1  # nor for its slope between the map's pixels; flatter light hardly counts
RETURNED = 0.3  # of the light that comes from where the head itself is: skin, lit about as the rest
CALM = 8  # rounds of means: an edge of the depth maps is no edge of a shadow
SCALE = 0.12  # of the shading: skin varies by less, brows and lips by more, and count less
SAMPLES = 150.0  # spots of skin that vary by themselves; freckles and folds are as large as that
PRIOR = 1.0  # standard deviation of a coefficient where the even light has 3.5; a studio's lamps make 2 to 3
MIN_UNHIDDEN = 0.3  # of the face's brightness: walls and ceiling send that much back to what no lamp reaches
ITERATIONS = 25
MIN_VERTICES = 100


@dataclass(frozen=True, slots=True, eq=False)
class Light:
    """Holds the light in which a head was photographed.

    Attributes:
        coefficients: radiance in the order of ``harmonics``, world frame, one column for each channel.
        residual: median relative error of the face's linear colours under this light.
        on_chart: whether the light is scaled so that white on the chart is white; else its mean over the sphere is 1.
    """

    coefficients: Float[np.ndarray, "9 3"]
    residual: float
    on_chart: bool = False


def harmonics(directions: Float[np.ndarray, "n 3"]) -> Float[np.ndarray, "n 9"]:
    """Returns the nine real spherical harmonics up to second order at unit vectors, in this order: 1; y, z, x; xy, yz,
    3z2 - 1, xz, x2 - y2 (Ramamoorthi and Hanrahan, eq. (3))."""
    x, y, z = directions.T
    columns = (
        0.282095 * np.ones_like(x),
        0.488603 * y,
        0.488603 * z,
        0.488603 * x,
        1.092548 * x * y,
        1.092548 * y * z,
        0.315392 * (3 * z**2 - 1),
        1.092548 * x * z,
        0.546274 * (x**2 - y**2),
    )
    return np.stack(columns, axis=1)


def spread_directions(count: int) -> Float[np.ndarray, "n 3"]:
    """Returns ``count`` unit vectors spread evenly over the sphere."""
    index = np.arange(count) + 0.5
    z, angle = 1.0 - 2.0 * index / count, index * np.pi * (3.0 - np.sqrt(5.0))
    ring = np.sqrt(1.0 - z**2)
    return np.stack([ring * np.cos(angle), ring * np.sin(angle), z], axis=1)


SURROUND = harmonics(spread_directions(DIRECTIONS)) * BAND_FACTORS  # unhidden white, turned everywhere


def transfer(
    mesh_world: Mesh, normals: Float[np.ndarray, "v 3"], around: Neighbourhood, directions: int = DIRECTIONS
) -> Float[np.ndarray, "v 9"]:
    """Computes the brightness that each vertex of a matt white mesh has under each of the nine harmonics as the light.
    Light that the mesh blocks is left out, except for the fraction that the blocking surface reflects."""
    unhidden = harmonics(normals) * BAND_FACTORS
    towards = spread_directions(directions)
    basis = harmonics(towards) * (4.0 / directions)  # the sphere's 4 pi by the matt surface's pi

    def hide(i: int) -> tuple[Int[np.ndarray, " n"], Float[np.ndarray, "n 9"]]:
        cosine = np.clip(normals @ towards[i], 0.0, None)
        facing = np.flatnonzero(cosine > 0)
        share = _hidden(_lamp_camera(mesh_world, towards[i]), mesh_world, facing, cosine[facing])
        return facing, (cosine[facing] * share)[:, None] * basis[i]

    hidden = np.zeros_like(unhidden)
    for facing, part in map_in_threads(hide, directions):  # in order, so that the sum has the same bits on any machine
        hidden[facing] += part
    return unhidden - (1.0 - RETURNED) * around.smooth(hidden, CALM)


def _lamp_camera(mesh: Mesh, towards: Float[np.ndarray, " 3"]) -> Camera:
    low, high = mesh.vertices.min(axis=0), mesh.vertices.max(axis=0)
    centre, radius = (low + high) / 2, float(np.linalg.norm(high - low)) / 2
    up = np.array([0.0, 0.0, 1.0]) if abs(towards[1]) > 0.9 else np.array([0.0, 1.0, 0.0])
    focal, middle = 0.5 * MAP_PX * FAR_RADII / 1.1, (MAP_PX - 1) / 2
    lens = Intrinsics(MAP_PX, MAP_PX, focal, focal, middle, middle)
    return Camera("lamp", lens, look_at(centre + FAR_RADII * radius * towards, centre, up))


def _hidden(
    camera: Camera, mesh: Mesh, rows: Int[np.ndarray, " n"], cosine: Float[np.ndarray, " n"]
) -> Float[np.ndarray, " n"]:
    """Returns the fraction of a lamp's light that is blocked at each vertex, as a shadow map gives it: a mean over the
    four nearest pixels, with a depth tolerance for the surface's slope."""
    depth, _ = depth_map(camera, mesh.vertices, mesh.faces)
    points = mesh.vertices[rows]
    x, y = np.clip(project_points(camera, points), 0, MAP_PX - 1.001).T
    left, top = x.astype(int), y.astype(int)
    across, down = x - left, y - top
    depths = camera_depths(camera, points)
    slope = np.sqrt(1.0 - np.minimum(cosine, 1.0) ** 2) / np.maximum(cosine, MIN_COSINE)
    limit = depths - BIAS_MM - SLOPE_PX * slope * depths / camera.intrinsics.fx
    share = np.zeros(len(points))
    for dy, wy in ((0, 1 - down), (1, down)):
        for dx, wx in ((0, 1 - across), (1, across)):
            share += wx * wy * (depth[top + dy, left + dx] < limit)
    return share


def fit_light(
    white: Float[np.ndarray, "v 9"], colours: Float[np.ndarray, "v 3"], skin: Bool[np.ndarray, " v"]
) -> Light | None:
    """Estimates the light from the linear colours of skin, whose true colour is assumed to be the same everywhere.
    Returns None if there are too few vertices, or if they are black.

    Args:
        white: the ``transfer`` of the vertices.
        colours: linear, without highlights.
        skin: vertices to use, brows and lips among them.
    """
    rows, seen = white[skin], colours[skin]
    level = np.median(seen, axis=0) if len(seen) else np.zeros(3)
    if len(seen) < MIN_VERTICES or level.min() <= 0:
        return None
    # In units of an evenly lit vertex; what the even light is worth is left free, the rest is drawn to zero.
    relative = seen / level
    prior = np.diag(np.r_[0.0, np.full(8, (SCALE / PRIOR) ** 2 / SAMPLES)])
    weights, found, off = np.ones(len(rows)), np.zeros((9, 3)), np.zeros_like(relative)
    stiffness = 3.0 / len(SURROUND)  # firm beside the samples, which have 1 in all
    for _ in range(ITERATIONS):
        weighted = rows * (weights / weights.sum())[:, None]
        bounded = _bounds(found)
        left = rows.T @ weighted + prior + bounded.T @ bounded * stiffness
        right = weighted.T @ relative + MIN_UNHIDDEN * stiffness * bounded.sum(axis=0)[:, None]
        found = np.linalg.solve(left, right)
        off = (relative - rows @ found) / np.maximum(rows @ found, 0.1)
        weights = 1.0 / (1.0 + (off**2).mean(axis=1) / SCALE**2)
    mean = found[0] * 0.282095  # the first harmonic is the mean over the sphere
    if not (mean > 0).all():
        return None
    return Light(found / mean, float(np.median(np.sqrt((off**2).mean(axis=1)))))


def _bounds(coefficients: Float[np.ndarray, "9 3"]) -> Float[np.ndarray, "n 9"]:
    """Returns the harmonics at the directions in which the estimated light is darker than in any real studio."""
    dark = (SURROUND @ coefficients).mean(axis=1) < MIN_UNHIDDEN
    return SURROUND[dark] if coefficients.any() else SURROUND[:0]
