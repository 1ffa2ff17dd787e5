"""Moves the vertices to the depth maps, which restores detail below the grid's step, and measures the uncertainty of
each."""

from dataclasses import dataclass

import numpy as np
from jaxtyping import Float, Int, Int32, Int64, UInt8

from pipeline.compute.threads import in_threads
from pipeline.compute.trace import traced
from pipeline.fusion.refinement_kernels import measure, smooth_offsets
from pipeline.fusion.view_stack import ViewStack
from pipeline.geometry.fans import corners_at_vertices
from rig.mesh import Mesh, vertex_normals

GATE_STEPS = 1.5  # a view that is farther off shows another surface
AGREEMENT_MM = 1.0  # of views, for the same surface
FLOOR_MM = 0.1
STIFFNESS = 10.0  # 1/mm2: of neighbouring offsets; a good view's information is 20 to 40
ROUNDS, SWEEPS = 2, 6


@dataclass(frozen=True, slots=True, eq=False)
class Measured:
    """Holds what the views measure at every vertex: its offset (mm) along the normal, ``information`` (1/mm2) and
    ``scatter`` (mm2) as in ``refinement_kernels.measure``, and how many ``views`` see it."""

    offset_mm: Float[np.ndarray, " v"]
    information: Float[np.ndarray, " v"]
    scatter: Float[np.ndarray, " v"]
    views: UInt8[np.ndarray, " v"]


@traced
def refine_vertices(mesh_world: Mesh, views: ViewStack, step_mm: float) -> tuple[Mesh, Measured]:
    """Moves the vertices along their normals to where the depth maps see the surface. Returns the moved mesh, and the
    views' measurements at its vertices."""
    starts, indices = neighbours(mesh_world.faces, len(mesh_world.vertices))
    mesh, root = mesh_world, np.full(len(mesh_world.vertices), np.sqrt(STIFFNESS))
    for _ in range(ROUNDS):
        normals = vertex_normals(mesh.vertices, mesh.faces)
        found = measure_vertices(mesh, normals, views, GATE_STEPS * step_mm)
        moved = smooth_offsets(found.offset_mm, found.offset_mm, found.information, starts, indices, root, SWEEPS, 1.0)
        mesh = Mesh(mesh.vertices + np.clip(moved, -step_mm, step_mm)[:, None] * normals, mesh.faces)
    normals = vertex_normals(mesh.vertices, mesh.faces)
    return mesh, measure_vertices(mesh, normals, views, AGREEMENT_MM)


def neighbours(faces: Int[np.ndarray, "f 3"], count: int) -> tuple[Int64[np.ndarray, " s"], Int32[np.ndarray, " e"]]:
    """Returns the neighbours of each vertex of a closed mesh in compressed rows: where each row starts (count + 1), and
    the vertex numbers, row after row."""
    starts, corner = corners_at_vertices(faces, count)  # a closed mesh has each edge once in either direction
    return starts, np.roll(faces, -1, axis=1).ravel()[corner].astype(np.int32)


def measure_vertices(mesh: Mesh, normals: Float[np.ndarray, "v 3"], views: ViewStack, gate_mm: float) -> Measured:
    """Measures every vertex against the depth maps of all views. A view whose depth differs by more than ``gate_mm``
    shows another surface and does not count."""
    count = len(mesh.vertices)
    offset, information, scatter = (np.zeros(count) for _ in range(3))
    seen = np.zeros(count, np.uint8)
    limits = np.array([gate_mm, AGREEMENT_MM, FLOOR_MM])
    vertices, packed = mesh.vertices, views.packed()

    def fill(first: int, last: int) -> None:
        measure(vertices, normals, packed, limits, offset, information, scatter, seen, first, last)

    in_threads(count, fill)
    return Measured(offset, information, scatter, seen)
