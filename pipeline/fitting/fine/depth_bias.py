"""What depth maps err alike, taken off before the head is drawn to them.

Two things, both measured on the very capture by its fitted face, whose cameras and shape were solved together and by
patches that follow the surface. Windows that match two and two lie 0.07 to 0.15 mm too deep all over the face. And a
window takes a curved surface for flatter than it is: it cuts off what stands out (the bridge of the nose, the lips) and
fills what lies back. To first order that is ``share`` times the height of the surface's own mean, over a window of
2.5 mm, above it. On captures of two renderers the share was 0.7 to 1.5, within 0.1 the same from the fitted face as
from the true one.
"""

from dataclasses import replace

import numpy as np
from jaxtyping import Bool, Float
from scipy.spatial import KDTree

from pipeline.dense.part_votes import SKIN
from pipeline.estimation.robust import Cauchy
from pipeline.fitting.fine.association import associate, interpolated
from pipeline.fitting.fine.surface_points import SurfacePoints
from rig.mesh import Mesh

REACH_MM, AGREEMENT, LEAST_POINTS = 2.0, 0.8, 300
WINDOW_MM, NEIGHBOURS = 2.5, 48  # standard deviation of the window, and vertices within it
ROBUST_MM, ROUNDS = 0.15, 10
MOST_MM, SHARE_MOST = 0.3, 2.0  # of the common offset, and of the share: beyond, something else is wrong


def without_window_bias(surface: SurfacePoints, head_world: Mesh, face: Bool[np.ndarray, " v"]) -> SurfacePoints:
    """The points moved along the head's normals by what their windows make of its shape.

    Args:
        surface: of depth maps, world frame, mm.
        head_world: the fitted head.
        face: its vertices that tell how large the share is, and where points are corrected by it.

    Returns:
        The points; unchanged where too few of them show the face.
    """
    vertices, faces, normals = head_world.vertices, head_world.faces, head_world.normals()
    skin = np.flatnonzero(surface.part == SKIN)
    found = associate(
        surface.points[skin],
        surface.normals[skin],
        vertices,
        normals,
        faces,
        reach_mm=REACH_MM,
        least_agreement=AGREEMENT,
    )
    corner = faces[found.triangle]
    on_face = face[corner].all(axis=1)
    if np.count_nonzero(on_face) < LEAST_POINTS:
        return surface
    row, corner, blend = skin[found.row[on_face]], corner[on_face], found.blend[on_face]
    ahead = interpolated(normals[corner], blend)
    off_mm = ((surface.points[row] - interpolated(vertices[corner], blend)) * ahead).sum(axis=1)
    flatter_mm = (windowed_height(vertices, normals)[corner] * blend).sum(axis=1)
    common_mm, share = _line(flatter_mm, off_mm)
    points = surface.points - common_mm * surface.normals
    points[row] = surface.points[row] - (common_mm + share * flatter_mm)[:, None] * ahead
    return replace(surface, points=points)


def windowed_height(vertices: Float[np.ndarray, "v 3"], normals: Float[np.ndarray, "v 3"]) -> Float[np.ndarray, " v"]:
    """How far (mm, along the normal) the mean of the surface over a window lies above each vertex; sheets that face
    another way do not count."""
    distance, near = KDTree(vertices).query(vertices, k=min(NEIGHBOURS, len(vertices)), workers=-1)
    weight = np.exp(-0.5 * (distance / WINDOW_MM) ** 2)
    weight *= np.maximum(np.einsum("vkc,vc->vk", normals[near], normals), 0.0)
    height = np.einsum("vkc,vc->vk", vertices[near], normals) - (vertices * normals).sum(axis=1)[:, None]
    return (weight * height).sum(axis=1) / weight.sum(axis=1)


def _line(x: Float[np.ndarray, " n"], y: Float[np.ndarray, " n"]) -> tuple[float, float]:
    """Offset and slope of a robust line, within what may be."""
    columns = np.stack([np.ones(len(x)), x], axis=1)
    line, loss = np.array([np.median(y), 0.0]), Cauchy(ROBUST_MM)
    for _ in range(ROUNDS):
        weight = np.sqrt(loss.weight((y - columns @ line) ** 2))
        line = np.linalg.lstsq(columns * weight[:, None], y * weight, rcond=None)[0]
    return float(np.clip(line[0], -MOST_MM, MOST_MM)), float(np.clip(line[1], 0.0, SHARE_MOST))
