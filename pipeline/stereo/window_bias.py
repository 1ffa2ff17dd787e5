"""Describes the bias that the windows of dense matching give a surface, and subtracts it.

All of the surface lies a little too deep, and curved parts come out too flat: what protrudes (the bridge of the nose,
the lips) is cut off, and hollows are filled. To first order the flattening is ``share`` times the height of the
surface's own mean, over a window of 2.5 mm, above the surface. ``pipeline.detail.depth_bias`` measures both on each
capture.
"""

from dataclasses import dataclass

import numpy as np
from jaxtyping import Bool, Float

from pipeline.compute.threads import in_threads
from pipeline.geometry.nearest import sorted_into_cells
from pipeline.stereo.depth_map_kernels import windowed_heights
from rig.mesh import Mesh

WINDOW_MM, REACH_MM = 2.5, 6.25  # standard deviation of the window, and where it ends


@dataclass(frozen=True, slots=True)
class WindowBias:
    """Holds the bias of dense matching along the surface normal: ``common_mm`` everywhere, plus ``share`` times
    ``windowed_height``."""

    common_mm: float = 0.0
    share: float = 0.0


def windowed_height(
    vertices: Float[np.ndarray, "v 3"], normals: Float[np.ndarray, "v 3"], wanted: Bool[np.ndarray, " v"] | None = None
) -> Float[np.ndarray, " v"]:
    """Computes how far (mm, along the normal) the mean of the surface over a window lies above each vertex. Parts of
    the window that face another way do not count. If ``wanted`` is not None, vertices outside it get 0."""
    order, keys, spans = sorted_into_cells(vertices, REACH_MM)
    chosen = np.ones(len(vertices), bool) if wanted is None else wanted[order]
    surface = np.concatenate([(vertices - vertices.min(axis=0)).T, normals.T])[:, order].astype(np.float32, order="C")
    sorted_mm, height_mm = np.zeros(len(vertices), np.float32), np.empty(len(vertices))

    def fill(first: int, last: int) -> None:
        windowed_heights(surface, chosen, keys, spans, WINDOW_MM, REACH_MM, sorted_mm, first, last)

    in_threads(len(vertices), fill)
    height_mm[order] = sorted_mm
    return height_mm


def without_bias(mesh_world: Mesh, measured: Bool[np.ndarray, " v"], bias: WindowBias) -> Mesh:
    """Returns the mesh with the bias of the matching windows subtracted at its measured vertices, along their
    normals."""
    if bias == WindowBias():
        return mesh_world
    vertices, normals = mesh_world.vertices, mesh_world.normals()
    off_mm = bias.common_mm + bias.share * windowed_height(vertices, normals, measured)
    return Mesh(vertices - np.where(measured, off_mm, 0.0)[:, None] * normals, mesh_world.faces)
