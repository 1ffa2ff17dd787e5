"""Computes how a texture lies on the surface: millimetres a texel, and how the light falls on it."""

from dataclasses import dataclass

import cv2
import numpy as np
from jaxtyping import Float, Float32, Int

from pipeline.geometry.raster_kernels import interpolate, rasterise
from pipeline.texturing.layout.uv_unwrap import Layout, spread_texels
from pipeline.texturing.light import BAND_FACTORS, harmonics
from rig.mesh import Mesh

COARSE = 1024  # side of the images: metric and light are smooth
STEP = 1e-3  # of a normal, for the slope of the light


@dataclass(frozen=True, slots=True, eq=False)
class TexelFrames:
    """Holds small images over the layout, one value for each texel of ``COARSE``.

    Attributes:
        metric: uu, uv and vv of the squared length (mm2) of a step by one whole image along u and v.
        slope: by how much the logarithm of the light grows with the height's slope: its factors of dh/du and dh/dv,
            where u and v are 1 over the image (1/mm, contravariant).
        skin: share of the relief that is wanted, 0 to 1.
    """

    metric: Float32[np.ndarray, "s s 3"]
    slope: Float32[np.ndarray, "s s 2"]
    skin: Float32[np.ndarray, "s s"]

    def image_mm(self) -> float:
        """Returns the width (mm) of the image at the scale of most of the skin."""
        metric = self.metric[self.skin > min(0.5, float(self.skin.max()))]
        area2 = metric[:, 0] * metric[:, 2] - metric[:, 1] ** 2
        return float(np.median(np.maximum(area2, 0.0)) ** 0.25) if len(area2) else 1.0

    def at(self, image: Float32[np.ndarray, "s s *c"], x: np.ndarray, y: np.ndarray) -> np.ndarray:
        """Reads an image at points of the unit square."""
        column, row = ((COARSE * at - 0.5).astype(np.float32) for at in (x, y))
        return cv2.remap(image, column, row, cv2.INTER_LINEAR, borderMode=cv2.BORDER_REPLICATE)


def texel_frames(
    layout: Layout,
    mesh_world: Mesh,
    normals: Float[np.ndarray, "v 3"],
    light: Float[np.ndarray, "9"],
    shading: Float[np.ndarray, " v"],
    skin: Float[np.ndarray, " v"],
) -> TexelFrames:
    """Computes the images of a head.

    ``layout``: of its vertices. ``mesh_world``: the head, mm. ``normals``: unit, of the vertices. ``light``: harmonics
    of the light (``pipeline.texturing.light``). ``shading``: of the vertices in that light, shadows included. ``skin``:
    share of the relief that is wanted at each vertex, 0 to 1.
    """
    along_u, along_v = _steps(layout, mesh_world)
    pull = light_slopes(normals, light) / np.maximum(shading, 1e-3)[:, None]
    pull = pull[layout.source]
    uu, uv, vv = ((a * b).sum(axis=1) for a, b in ((along_u, along_u), (along_u, along_v), (along_v, along_v)))
    on_u, on_v = ((pull * step).sum(axis=1) for step in (along_u, along_v))
    area2 = np.maximum(uu * vv - uv**2, 1e-9)
    slope = np.stack([vv * on_u - uv * on_v, uu * on_v - uv * on_u], axis=1) / area2[:, None]
    values = np.concatenate([np.stack([uu, uv, vv], axis=1), slope, skin[layout.source, None]], axis=1)
    image = _image(layout, values)
    return TexelFrames(image[:, :, :3].copy(), image[:, :, 3:5].copy(), image[:, :, 5].copy())


def light_slopes(normals: Float[np.ndarray, "v 3"], light: Float[np.ndarray, "9"]) -> Float[np.ndarray, "v 3"]:
    """Returns the gradient of the light by the normal, in the surface."""
    by_axis = []
    for axis in np.eye(3):
        either = [harmonics(_unit(normals + sign * STEP * axis)) * BAND_FACTORS @ light for sign in (1.0, -1.0)]
        by_axis.append((either[0] - either[1]) / (2 * STEP))
    return np.stack(by_axis, axis=1)


def _unit(vectors: Float[np.ndarray, "v 3"]) -> Float[np.ndarray, "v 3"]:
    return vectors / np.linalg.norm(vectors, axis=1, keepdims=True)


def _steps(layout: Layout, mesh: Mesh) -> tuple[Float[np.ndarray, "n 3"], Float[np.ndarray, "n 3"]]:
    """Steps on the surface (mm) for one whole image along u and along v: means over the triangles of each corner."""
    corners, flat = mesh.vertices[layout.source][layout.faces], layout.uv[layout.faces]
    edge, other = corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0]
    (s, t), (p, q) = (flat[:, 1] - flat[:, 0]).T, (flat[:, 2] - flat[:, 0]).T
    area = s * q - t * p
    area = np.where(np.abs(area) > 1e-12, area, 1e-12)[:, None]
    along = ((edge * q[:, None] - other * t[:, None]) / area, (other * s[:, None] - edge * p[:, None]) / area)
    count = np.maximum(np.bincount(layout.faces.ravel(), minlength=len(layout.uv)), 1)[:, None]
    along_u, along_v = (_sums(layout.faces, step, len(layout.uv)) / count for step in along)
    return along_u, along_v


def _sums(faces: Int[np.ndarray, "f 3"], values: Float[np.ndarray, "f 3"], count: int) -> Float[np.ndarray, "n 3"]:
    columns = [np.bincount(faces.ravel(), np.repeat(values[:, axis], 3), count) for axis in range(3)]
    return np.stack(columns, axis=1)


def _image(layout: Layout, values: Float[np.ndarray, "n k"]) -> Float32[np.ndarray, "s s k"]:
    texels, ones = COARSE * layout.uv - 0.5, np.ones(len(layout.uv))
    _, shown = rasterise(texels, ones, layout.faces, COARSE, COARSE)
    return spread_texels(interpolate(shown, texels, ones, layout.faces, values.astype(np.float32)), shown >= 0)
