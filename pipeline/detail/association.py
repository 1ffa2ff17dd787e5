"""Assigns each measured surface point to the closest point of the head with a similar normal, and makes observations
of the head from these pairs.

The search for pairs goes from the measured points to the head, so parts of the head without measured points, and the
borders of such holes, get no observation.
"""

from dataclasses import dataclass

import numpy as np
from jaxtyping import Bool, Float, Int

from pipeline.compute.threads import in_threads
from pipeline.detail.dense_points import SurfacePoints
from pipeline.detail.patch_points import PatchMeasurements
from pipeline.detail.solve import Observed
from pipeline.geometry.nearest import PointTree, nearest
from pipeline.geometry.surface_index import corners_at_vertices
from pipeline.geometry.surface_kernels import FannedMesh, closest_at_vertices
from pipeline.part_labels.codes import Part
from rig.mesh import vertex_normals

Vertices = Float[np.ndarray, "v 3"]
PerVertex = Float[np.ndarray, " v"]
Faces = Int[np.ndarray, "f 3"]

CANDIDATES = 4  # vertices whose triangles are tried
CORRELATION_MM = 4.0  # radius within which points err alike: windows of dense matching overlap
PATCH_REACH_MM = 4.0  # no dense point counts so near to a patch, whose window reaches as far


@dataclass(frozen=True, slots=True, eq=False)
class Associated:
    """Holds the indices of the n surface points near a head, and the closest point on the head's mesh for each."""

    row: Int[np.ndarray, " n"]  # of the points asked for
    triangle: Int[np.ndarray, " n"]
    blend: Float[np.ndarray, "n 3"]  # barycentric weights of its corners
    distance_mm: Float[np.ndarray, " n"]


@dataclass(frozen=True, slots=True, eq=False)
class Target:
    """Holds a head's mesh with a search tree for closest points."""

    head: FannedMesh
    tree: PointTree
    corner_mm: float  # from no place of a triangle is its nearest corner farther

    @classmethod
    def of(cls, vertices: Float[np.ndarray, "v 3"], vertex_normals: Float[np.ndarray, "v 3"], faces: Faces) -> "Target":
        """Builds a target from a mesh (mm) with unit vertex normals."""
        sides = [np.linalg.norm(vertices[faces[:, j]] - vertices[faces[:, j - 1]], axis=1) for j in range(3)]
        start, corner = corners_at_vertices(faces, len(vertices))
        head = FannedMesh(vertices, vertex_normals, faces, start, corner // 3)
        return cls(head, PointTree.of(vertices), float(np.max(sides, initial=0.0)))

    def closest(
        self,
        points: Float[np.ndarray, "p 3"],
        normals: Float[np.ndarray, "p 3"],
        *,
        reach_mm: float,
        least_agreement: float,
    ) -> Associated:
        """Finds, for each surface point, the closest point on the head within reach.

        Args:
            points: measured surface points, mm, in the head's frame.
            normals: unit, outwards.
            reach_mm: points farther away are left out.
            least_agreement: smallest cosine between a point's normal and the head's.

        Returns:
            The points that have a closest point within reach, in their order.
        """
        count = min(CANDIDATES, len(self.head.vertices))
        within = reach_mm + self.corner_mm
        _, near = nearest(self.tree, points, count=count, within=within)
        near = near.reshape(len(points), count)
        triangle = np.empty(len(points), np.int64)
        blend, square = np.zeros((len(points), 3)), np.empty(len(points))

        def fill(first: int, last: int) -> None:
            closest_at_vertices(first, last, points, normals, near, self.head, least_agreement, triangle, blend, square)

        in_threads(len(points), fill)
        row = np.flatnonzero((triangle >= 0) & (square <= reach_mm**2))
        return Associated(row, triangle[row], blend[row], np.sqrt(square[row]))


def interpolated(corners: Float[np.ndarray, "n 3 3"], blend: Float[np.ndarray, "n 3"]) -> Float[np.ndarray, "n 3"]:
    """Interpolates values at n points inside triangles from the three corners, with barycentric coordinates
    ``blend``."""
    return np.einsum("nk,nkc->nc", blend, corners)


@dataclass(frozen=True, slots=True)
class Round:
    """Holds the limits of one round of the deformation, which assigns the points to the head and solves for the
    displacement. ``agreement`` is the smallest cosine between a point's normal and the head's."""

    reach_mm: float
    loose_reach_mm: float
    agreement: float
    robust_mm: float


@dataclass(frozen=True, slots=True, eq=False)
class PointObservations:
    """Holds the observations of the head from surface points. The class also holds, for the n points of skin, the
    triangle on the head (corners and barycentric coordinates) and the standard deviation."""

    observed: Observed
    corner: Int[np.ndarray, "n 3"]
    blend: Float[np.ndarray, "n 3"]
    deviation_mm: Float[np.ndarray, " n"]


def observe(
    base: Vertices,
    current: Vertices,
    faces: Faces,
    surface: SurfacePoints,
    loose: Bool[np.ndarray, " v"],
    *,
    limits: Round,
    floor_mm: float,
) -> PointObservations:
    """Returns the observations from points near the head ``current``, as offsets (mm) from ``base``. A point of hair
    counts only where the head extends beyond the point.

    The normal of an observation is the mean of the point's and the head's normal (Rusinkiewicz 2019, *A symmetric
    objective function for ICP*), which is exact to second order for curved surfaces.
    """
    normals = vertex_normals(current, faces)
    found = Target.of(current, normals, faces).closest(
        surface.points, surface.normals, reach_mm=limits.loose_reach_mm, least_agreement=limits.agreement
    )
    corner = faces[found.triangle]
    reach = np.where(loose[corner].any(axis=1), limits.loose_reach_mm, limits.reach_mm)
    between = interpolated(normals[corner], found.blend) + surface.normals[found.row]
    between /= np.maximum(np.linalg.norm(between, axis=1, keepdims=True), 1e-9)
    point = surface.points[found.row]
    off = ((point - interpolated(current[corner], found.blend)) * between).sum(axis=1)
    skin = surface.part[found.row] == Part.SKIN
    informative = np.where(skin, found.distance_mm <= reach, off < 0.0)  # hair counts where the head reaches beyond it
    variance = surface.deviation_mm[found.row] ** 2 + floor_mm**2
    robust = np.where(skin, 1.0 / (1.0 + (off / limits.robust_mm) ** 2) ** 2, 1.0)
    shared = _local_density(found, corner, current, faces)
    offset = ((point - interpolated(base[corner], found.blend)) * between).sum(axis=1)
    retained, of_skin = np.flatnonzero(informative), np.flatnonzero(informative & skin)
    information = robust / (variance * shared)
    return PointObservations(
        Observed(corner[retained], found.blend[retained], between[retained], offset[retained], information[retained]),
        corner[of_skin],
        found.blend[of_skin],
        surface.deviation_mm[found.row[of_skin]],
    )


def add_patches(
    observed: Observed, found: PatchMeasurements, base: Vertices, current: Vertices, faces: Faces, robust_mm: float
) -> Observed:
    """Adds the patches' measurements on the head ``current``, and drops the observations from dense matching within
    ``PATCH_REACH_MM`` of a patch."""
    vertex, normals = found.vertex, vertex_normals(current, faces)[found.vertex]
    if not len(vertex):
        return observed
    measured = current[vertex] + found.distance_mm[:, None] * normals
    offset = ((measured - base[vertex]) * normals).sum(axis=1)
    information = found.information / (1.0 + (found.distance_mm / robust_mm) ** 2) ** 2
    at = interpolated(base[observed.corner], observed.blend)
    alone = nearest(PointTree.of(base[vertex]), at, within=PATCH_REACH_MM)[0] > PATCH_REACH_MM
    corner, blend = np.repeat(vertex[:, None], 3, axis=1), np.tile([1.0, 0.0, 0.0], (len(vertex), 1))
    return observed.chosen(alone).joined(Observed(corner, blend, normals, offset, information))


def typical_deviation(dense: PointObservations, faces: Faces, count: int) -> PerVertex:
    """Returns the mean standard deviation (mm) of the points of skin around each of ``count`` vertices; 0 without
    points."""
    if not len(dense.corner):
        return np.zeros(count)
    known = np.bincount(dense.corner.ravel(), dense.blend.ravel(), count)
    total = np.bincount(dense.corner.ravel(), (dense.blend * dense.deviation_mm[:, None]).ravel(), count)
    return _pooled(total, faces) / np.maximum(_pooled(known, faces), 1e-9)


def _pooled(values: PerVertex, faces: Faces) -> PerVertex:
    """Returns twice the sum of the values over the triangles around each vertex."""
    for _ in range(2):
        values = np.bincount(faces.ravel(), np.repeat(values[faces].sum(axis=1), 3), len(values))
    return values


def _local_density(
    found: Associated, corner: Int[np.ndarray, "n 3"], vertices: Vertices, faces: Faces
) -> Float[np.ndarray, " n"]:
    """Returns, for each point, the number of points within ``CORRELATION_MM``, which have the same error. The number
    follows from the points' density on the surface."""
    area = np.linalg.norm(np.cross(vertices[faces[:, 1]] - vertices[faces[:, 0]],
                                   vertices[faces[:, 2]] - vertices[faces[:, 0]]), axis=1) / 6.0  # fmt: skip
    mass = np.bincount(faces.ravel(), np.repeat(area, 3), len(vertices))
    count = np.bincount(corner.ravel(), found.blend.ravel(), len(vertices)).astype(float)  # of nothing it is integers
    density = (_pooled(count, faces) / np.maximum(_pooled(mass, faces), 1e-9))[corner].mean(axis=1)
    return np.maximum(1.0, density * np.pi * CORRELATION_MM**2)
