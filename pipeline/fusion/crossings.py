"""Finds triangles of a mesh that cross each other, and separates vertices that coincide."""

import numpy as np
from jaxtyping import Bool, Float, Int

from pipeline.compute.threads import in_threads
from pipeline.compute.trace import traced
from pipeline.fusion.crossing_kernels import beside_active, crossing_triangles, triangle_boxes
from pipeline.geometry.nearest import sorted_into_cells
from rig.mesh import Mesh

APART_SHARE = 0.05  # of the way to the middle of a vertex's neighbours: some 0.03 mm
SIZES = 4  # classes of triangles, each half as wide as the last


def crossing_faces(
    vertices: Float[np.ndarray, "v 3"], faces: Int[np.ndarray, "f 3"], active: Bool[np.ndarray, " f"] | None = None
) -> Bool[np.ndarray, " f"]:
    """Returns a mask of triangles that cross another triangle. If ``active`` is not None, only pairs with at least one
    active triangle are tested."""
    faces = faces.astype(np.int32)  # a copy: a model's own are read-only, which is another type
    if active is None:
        return _crossing_by_size(vertices, faces)
    if not active.any():
        return np.zeros(len(faces), bool)
    boxes, crossing = triangle_boxes(vertices, faces), np.zeros(len(faces), bool)
    near = np.flatnonzero(beside_active(boxes, active))
    crossing[near] = _crossing(vertices, faces[near], boxes[near], active[near])
    return crossing


def _crossing_by_size(vertices: Float[np.ndarray, "v 3"], faces: Int[np.ndarray, "f 3"]) -> Bool[np.ndarray, " f"]:
    """Returns a mask of triangles that cross another triangle. To make this fast, the mesh's triangles are divided into
    size classes. Each class is tested against itself and all smaller triangles in a grid with cells of its own size.
    """
    boxes, crossing = triangle_boxes(vertices, faces), np.zeros(len(faces), bool)
    wide = (boxes[:, 3:] - boxes[:, :3]).max(axis=1)
    widest = float(wide.max(initial=0.0))
    for size in range(SIZES):
        rows = np.flatnonzero(wide <= widest / 2.0**size)
        same_size = wide[rows] > (widest / 2.0 ** (size + 1) if size < SIZES - 1 else -1.0)
        if same_size.any():
            crossing[rows] |= _crossing(vertices, faces[rows], boxes[rows], same_size)
    return crossing


def _crossing(
    vertices: Float[np.ndarray, "v 3"],
    faces: Int[np.ndarray, "f 3"],
    boxes: Float[np.ndarray, "f 6"],
    active: Bool[np.ndarray, " f"],
) -> Bool[np.ndarray, " f"]:
    low, high = boxes[:, :3], boxes[:, 3:]
    cells = sorted_into_cells(0.5 * (low + high), max(float((high - low).max(initial=0.0)), 1e-9))
    crossing = np.zeros(len(faces), bool)
    sorted_boxes, (order, keys, spans) = boxes[cells.order], cells

    def mark(first: int, last: int) -> None:
        crossing_triangles(vertices, faces, sorted_boxes, order, keys, spans, active, crossing, first, last)

    in_threads(len(faces), mark)
    return crossing


@traced
def separate_coincidences(mesh: Mesh) -> Mesh:
    """Separates vertices that coincide in single precision, as files store them, by a small move towards the mean of
    their neighbours. If two vertices coincided, a program that merges vertices by position would join separate sheets
    of the surface."""
    stored = mesh.vertices.astype(np.float32)
    order = np.argsort(stored[:, 0])  # only what is equal there is sorted by all coordinates: a tenth of the time
    again = np.diff(stored[order, 0]) == 0.0
    maybe = np.sort(order[np.append(again, False) | np.append(False, again)])
    _, same, count = np.unique(stored[maybe], axis=0, return_inverse=True, return_counts=True)
    rows = maybe[count[same.ravel()] > 1]
    if not len(rows):
        return mesh
    vertices = mesh.vertices.copy()
    corners = mesh.faces[np.isin(mesh.faces, rows).any(axis=1)]
    for row in rows:
        beside = np.setdiff1d(corners[(corners == row).any(axis=1)], row)
        vertices[row] += APART_SHARE * (mesh.vertices[beside].mean(axis=0) - mesh.vertices[row])
    return Mesh(vertices, mesh.faces, mesh.colours)
