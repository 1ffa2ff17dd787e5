"""What windows of dense matching make of a surface, and how it is taken off.

They lie a little too deep all over, and they take a curved surface for flatter than it is: what stands out (the bridge
of the nose, the lips) is cut off, what lies back is filled. To first order that is ``share`` times the height of the
surface's own mean, over a window of 2.5 mm, above it. How large both are, ``pipeline.detail.depth_bias`` measures on
the very capture."""

from dataclasses import dataclass

import numpy as np
from jaxtyping import Bool, Float

from pipeline.compute.threads import in_threads
from pipeline.geometry.cells import sorted_into_cells
from pipeline.stereo.window_bias_kernels import windowed_heights
from rig.mesh import Mesh

WINDOW_MM, REACH_MM = 2.5, 6.25  # standard deviation of the window, and where it ends


@dataclass(frozen=True, slots=True)
class WindowBias:
    """Holds the bias of dense matching along the normal: ``common_mm``, the same everywhere, and ``share``, the factor
    of the windowed height."""

    common_mm: float = 0.0
    share: float = 0.0


def windowed_height(
    vertices: Float[np.ndarray, "v 3"],
    normals: Float[np.ndarray, "v 3"],
    wanted: Bool[np.ndarray, " v"] | None = None,
) -> Float[np.ndarray, " v"]:
    """Computes how far (mm, along the normal) the mean of the surface over a window lies above each vertex. Parts that
    face another way do not count. With ``wanted``, the other vertices get 0."""
    height_mm, cells = np.zeros(len(vertices)), sorted_into_cells(vertices, REACH_MM)
    chosen = (
        np.ones(len(vertices), bool) if wanted is None else wanted.copy()
    )  # a model's own is read-only: another type
    points, facing = np.ascontiguousarray(vertices), np.ascontiguousarray(normals)
    order, keys, spans = cells

    def fill(first: int, last: int) -> None:
        windowed_heights(points, facing, chosen, order, keys, spans, WINDOW_MM, REACH_MM, height_mm, first, last)

    in_threads(len(vertices), fill)
    return height_mm


def without_bias(mesh_world: Mesh, measured: Bool[np.ndarray, " v"], bias: WindowBias) -> Mesh:
    """Returns the mesh with the bias of the matching windows subtracted at its measured vertices, along their
    normals."""
    if bias == WindowBias():
        return mesh_world
    vertices, normals = mesh_world.vertices, mesh_world.normals()
    off_mm = bias.common_mm + bias.share * windowed_height(vertices, normals, measured)
    return Mesh(vertices - np.where(measured, off_mm, 0.0)[:, None] * normals, mesh_world.faces)
