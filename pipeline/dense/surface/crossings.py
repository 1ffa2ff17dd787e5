"""A mesh that does not cross itself: vertices go back, where it does, towards places where it cannot."""

import numpy as np
from jaxtyping import Bool, Float, Int

from pipeline.dense.cells import sorted_into_cells
from pipeline.dense.surface.crossing_kernels import crossing_triangles, triangle_boxes
from pipeline.parallel_for import in_threads
from rig.mesh import Mesh

ROUNDS_MOST = 40
HALVINGS = 6  # rounds in which vertices go half their way; later ones go all of it, and take their neighbours along


def crossing_faces(
    vertices: Float[np.ndarray, "v 3"], faces: Int[np.ndarray, "f 3"], active: Bool[np.ndarray, " f"] | None = None
) -> Bool[np.ndarray, " f"]:
    """Triangles that cross another one, among pairs of which one is ``active`` (all of them, if None)."""
    boxes = triangle_boxes(vertices, faces)
    low, high = boxes[:, :3], boxes[:, 3:]
    cells = sorted_into_cells(0.5 * (low + high), max(float((high - low).max()), 1e-9))
    crossing = np.zeros(len(faces), bool)
    chosen = np.ones(len(faces), bool) if active is None else active
    given = (vertices, faces, boxes, *cells, chosen, crossing)
    in_threads(len(faces), lambda first, last: crossing_triangles(*given, first, last))
    return crossing


def without_crossings(mesh: Mesh, safe: Float[np.ndarray, "v 3"]) -> tuple[Mesh, int]:
    """The mesh without self-intersections, and how many of its vertices moved; with all vertices in their ``safe``
    places it has none."""
    vertices, faces = mesh.vertices.copy(), mesh.faces
    moved = np.zeros(len(vertices), bool)
    active: Bool[np.ndarray, " f"] | None = None
    for done in range(ROUNDS_MOST):
        crossing = crossing_faces(vertices, faces, active)
        if not crossing.any():
            break
        back = np.zeros(len(vertices), bool)
        back[faces[crossing]] = True
        for _ in range(max(0, done - HALVINGS + 1)):
            back[faces[back[faces].any(axis=1)]] = True
        share = 0.5 if done < HALVINGS else 0.0
        vertices[back] = safe[back] + share * (vertices[back] - safe[back])
        moved |= back
        active = np.asarray(back[faces].any(axis=1))
    return Mesh(vertices, faces), int(moved.sum())
