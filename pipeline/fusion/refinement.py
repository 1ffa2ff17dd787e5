"""Moves the vertices of the fused surface to the depth maps, which restores detail finer than the grid. The module also
computes the standard deviation of each vertex, and which vertices are measured."""

from dataclasses import dataclass, replace

import numpy as np
from jaxtyping import Bool, Float, Int, Int32, Int64, UInt8

from pipeline.compute.threads import in_threads
from pipeline.compute.trace import traced
from pipeline.fusion.grid_kernels import component_of
from pipeline.fusion.view_stack import ViewStack
from pipeline.fusion.vote_kernels import measure, smooth_offsets
from pipeline.geometry.nearest import PointTree, nearest
from pipeline.geometry.surface_index import corners_at_vertices
from rig.mesh import Mesh, face_normals, vertex_normals

GATE_STEPS = 1.5  # a view that is farther off shows another surface
AGREEMENT_MM = 1.0  # of views, for the same surface
FLOOR_MM = 0.1
STIFFNESS = 10.0  # 1/mm2: of neighbouring offsets; a good view's information is 20 to 40
ROUNDS, SWEEPS = 2, 6
MIN_MM = 0.05  # what no view shows: the calibration's own error, and the surface between vertices
ALONE_MM = 0.3  # of what a single view says, beside its own deviation: nobody contradicts it
EDGE_MM, SLOPE, MAX_MM = 1.5, 0.25, 15.0  # a guess at the edge of what is seen, its growth with the distance, its end
# Smaller patches that views agree on, with nothing seen about them, are often chance: without this the farthest places
# of the laboratory's `planted` are six times as far off.
ISLAND_MM2 = 100.0


@dataclass(frozen=True, slots=True, eq=False)
class Measured:
    """Holds the views' measurements at every vertex: its offset (mm) along the normal, ``information`` (1/mm2) and
    ``scatter`` (mm2) as in ``vote_kernels.measure``, and the number of ``views`` that see it."""

    offset_mm: Float[np.ndarray, " v"]
    information: Float[np.ndarray, " v"]
    scatter: Float[np.ndarray, " v"]
    views: UInt8[np.ndarray, " v"]


@dataclass(frozen=True, slots=True, eq=False)
class SeenVertices:
    """Holds a mask of the vertices that a view sees (``themselves``), and for each vertex the nearest seen vertex and
    the distance (mm) to it."""

    themselves: Bool[np.ndarray, " v"]
    far_mm: Float[np.ndarray, " v"]
    nearest: Int[np.ndarray, " v"]

    @classmethod
    def of(cls, vertices: Float[np.ndarray, "v 3"], seen: Bool[np.ndarray, " v"]) -> "SeenVertices":
        """Finds, for each vertex, the nearest seen vertex and the distance to it; infinite if no vertex is seen."""
        far_mm, row, those = np.where(seen, 0.0, np.inf), np.arange(len(seen)), np.flatnonzero(seen)
        if len(those):
            far_mm[~seen], at = nearest(PointTree.of(vertices[those]), vertices[~seen])
            row[~seen] = those[at]
        return cls(seen, far_mm, row)

    def guess_deviation_mm(self) -> Float[np.ndarray, " v"]:
        """Returns the standard deviation (mm) of unseen vertices, which grows with the distance to seen ones; 0 for
        seen vertices."""
        return np.where(self.themselves, 0.0, np.minimum(EDGE_MM + SLOPE * self.far_mm, MAX_MM))


@traced
def refine_vertices(mesh_world: Mesh, views: ViewStack, step_mm: float) -> tuple[Mesh, Measured]:
    """Moves the vertices along their normals to the surface in the depth maps. Returns the moved mesh, and the views'
    measurements at its vertices."""
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
    shows another surface and is ignored."""
    count = len(mesh.vertices)
    offset, information, scatter = (np.zeros(count) for _ in range(3))
    seen = np.zeros(count, np.uint8)
    limits = np.array([gate_mm, AGREEMENT_MM, FLOOR_MM])
    vertices, packed = mesh.vertices, views.packed()

    def fill(first: int, last: int) -> None:
        measure(vertices, normals, packed, limits, offset, information, scatter, seen, first, last)

    in_threads(count, fill)
    return Measured(offset, information, scatter, seen)


def remove_islands(mesh: Mesh, measured: Measured) -> Measured:
    """Discards the measurements on small patches: connected patches of seen triangles with an area below ``ISLAND_MM2``
    then count as unseen."""
    seen = measured.views > 0
    faces = mesh.faces[seen[mesh.faces].all(axis=1)]
    piece = component_of(faces, len(seen))
    area = 0.5 * np.linalg.norm(face_normals(mesh.vertices, faces), axis=1)
    held = np.bincount(piece[faces[:, 0]], area, minlength=len(seen))[piece]
    return replace(measured, views=np.where(held < ISLAND_MM2, 0, measured.views).astype(np.uint8))


def deviation_mm(seen: SeenVertices, measured: Measured) -> Float[np.ndarray, " v"]:
    """Returns the standard deviation (mm) of each vertex along its normal, for seen and unseen vertices."""
    return np.where(seen.themselves, seen_deviation_mm(measured), seen.guess_deviation_mm())


def seen_deviation_mm(measured: Measured) -> Float[np.ndarray, " v"]:
    """Returns the standard deviation (mm) along the normal of every seen vertex, from the views' information or, if
    larger, their scatter; 0 for unseen vertices."""
    seen = measured.views > 0
    views = measured.views[seen].astype(float)
    variance = np.maximum(1.0 / measured.information[seen], measured.scatter[seen] / np.maximum(views - 1.0, 1.0))
    variance += np.where(views < 2, ALONE_MM**2, 0.0) + MIN_MM**2
    out = np.zeros(len(seen))
    out[seen] = np.minimum(np.sqrt(variance), MAX_MM)
    return out
