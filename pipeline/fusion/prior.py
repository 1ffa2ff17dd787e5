"""Predicts the surface where hardly any camera sees it, from the fitted head and the visual hull. The offsets of head
and hull from the surface are extrapolated from regions that cameras see.

Of head and hull, the one nearer to the seen surface around a point has more weight there. The hull is exact to a
millimetre around a skull, where the fitted head may be 6 to 12 mm too deep. Below brows and chin, and with all cameras
on one side, the head is better.
"""

from dataclasses import dataclass

import numpy as np
from jaxtyping import Bool, Float, Int

from pipeline.geometry.nearest import PointTree, nearest
from pipeline.geometry.surface_index import SurfaceIndex
from rig.mesh import Mesh, boundary_edges

THICKEST_MM = 60.0  # of hair: farther out a point belongs to something else
RIM_MM = 12.0  # about the open rim of a model the head goes on in a way that it does not know
EVERY = 4  # vertices of the head stand for the others: 3 mm apart is enough for a guess
MIN_POINTS = 3  # of the surface near a vertex, for a thickness
NEAREST, EVEN_MM = 64, 5.0  # vertices that a mean is taken of, and the distance within which they count alike
SURE_MM = 0.5  # no guess is better
# About an ear within which the head says where it ends. And how far it may stand out of its outlines, which would cut a
# thin rim to shreds.
EAR_MM, EAR_SPARED_MM = 15.0, 10.0
MIN_COSINE = 0.1  # between a ray and a head's surface: a cone nine radii off says nothing
CANDIDATES = 8  # of the head's triangles, for the one nearest to a place


@dataclass(frozen=True, slots=True, eq=False)
class SeenSurface:
    """Holds m points of the surface that cameras see (world frame, mm), their signed distances to the visual hull (mm,
    negative inside), and their weights."""

    points: Float[np.ndarray, "m 3"]
    hull_mm: Float[np.ndarray, " m"]
    weight: Float[np.ndarray, " m"]


def distance_to_subject(
    places: Float[np.ndarray, "n 3"],
    hull_mm: Float[np.ndarray, " n"],
    head_world: Mesh,
    seen: SeenSurface,
    cameras: Float[np.ndarray, "k 3"],
) -> Float[np.ndarray, " n"]:
    """Returns the signed distance (mm, positive outside) of points to the predicted surface; -inf near the open border
    of the head.

    Args:
        places: the points, world frame, mm.
        hull_mm: their signed distances to the visual hull.
        head_world: the fitted head.
        seen: points of the seen surface, from which the offsets of head and hull are extrapolated.
        cameras: the centres of the cameras, world frame, mm.
    """
    vertices, normals = head_world.vertices[::EVERY], head_world.normals()[::EVERY]
    tree = PointTree.of(vertices)
    excess_mm = hull_excess_mm(vertices, normals, cameras)
    (thickness, gap), (head_square, hull_square) = _offsets(tree, normals, seen, excess_mm)
    gap += excess_mm
    hull_square += excess_mm**2
    far, near = nearest(tree, places)
    height = ((places - vertices[near]) * normals[near]).sum(axis=1)
    by_head, by_hull = np.copysign(far, height) - thickness[near], hull_mm + gap[near]
    share = (hull_square / (hull_square + head_square))[near]
    return np.where(near_rim(head_world, vertices)[near], -np.inf, share * by_head + (1.0 - share) * by_hull)


def hull_excess_mm(
    vertices: Float[np.ndarray, "v 3"], normals: Float[np.ndarray, "v 3"], cameras: Float[np.ndarray, "k 3"]
) -> Float[np.ndarray, " v"]:
    """Returns how far (mm) the visual hull lies outside a head at its vertices. A camera's cone touches the head where
    the camera's ray is tangential; a ball of the same radius tells how far the cone is off elsewhere."""
    rays = vertices[:, None] - cameras
    sines = np.abs((rays * normals[:, None]).sum(axis=2)) / np.linalg.norm(rays, axis=2)
    cosine = np.sqrt(np.maximum(1.0 - sines.min(axis=1) ** 2, MIN_COSINE**2))
    return np.linalg.norm(vertices - vertices.mean(axis=0), axis=1) * (1.0 / cosine - 1.0)


def _offsets(
    tree: PointTree, normals: Float[np.ndarray, "v 3"], seen: SeenSurface, excess_mm: Float[np.ndarray, " v"]
) -> tuple[Float[np.ndarray, "2 v"], Float[np.ndarray, "2 v"]]:
    """Returns the offsets (mm) of the seen surface from the head and from the hull around each vertex of the head, and
    their mean squares (mm^2). The offsets are extrapolated from vertices near seen points by inverse squared distances.
    With too few measured points only the head is used, with offset 0."""
    vertices = tree.points
    far, near = nearest(tree, seen.points, within=THICKEST_MM)
    within = np.isfinite(far)
    near, weight = near[within], seen.weight[within]
    height = np.maximum(((seen.points[within] - vertices[near]) * normals[near]).sum(axis=1), 0.0)
    depth = np.maximum(-seen.hull_mm[within], 0.0) - excess_mm[near]
    known = np.flatnonzero(np.bincount(near, minlength=len(vertices)) >= MIN_POINTS)
    if len(known) < NEAREST:
        return np.zeros((2, len(vertices))), np.tile([[0.0], [1.0]], len(vertices))
    far, among = nearest(PointTree.of(vertices[known]), vertices, count=NEAREST)
    means, squares = np.empty((2, len(vertices))), np.empty((2, len(vertices)))
    for row, (off_mm, sure) in enumerate([(height, weight), (depth, weight / (excess_mm[near] + EVEN_MM) ** 2)]):
        total = np.bincount(near, sure, len(vertices))[known]
        mean_mm = np.bincount(near, sure * off_mm, len(vertices))[known] / total
        share = total[among] / (far * far + EVEN_MM**2)
        share /= share.sum(axis=1, keepdims=True)
        means[row] = (share * mean_mm[among]).sum(axis=1)
        squares[row] = (share * mean_mm[among] ** 2).sum(axis=1) + SURE_MM**2
    return means, squares


def distance_about_ears(
    head_world: Mesh, ears: Float[np.ndarray, "m 3"], places: Float[np.ndarray, "n 3"]
) -> tuple[Int[np.ndarray, " k"], Float[np.ndarray, " k"]]:
    """Returns the indices of the points within ``EAR_MM`` of the ears, and their signed distances (mm, positive
    outside) to the head."""
    low, high = ears.min(axis=0) - EAR_MM, ears.max(axis=0) + EAR_MM
    rows = np.flatnonzero(((places > low) & (places < high)).all(axis=1))
    rows = rows[nearest(PointTree.of(ears), places[rows], within=EAR_MM)[0] < EAR_MM]
    about = places[rows]
    hit = SurfaceIndex(head_world.vertices, head_world.faces).closest(about, CANDIDATES)
    normals = np.einsum("nk,nkx->nx", hit.weights, head_world.normals()[head_world.faces[hit.triangles]])
    return rows, np.copysign(hit.distances, ((about - hit.points) * normals).sum(axis=1))


def near_rim(head_world: Mesh, places: Float[np.ndarray, "n 3"], within_mm: float = RIM_MM) -> Bool[np.ndarray, " n"]:
    """Returns a mask of the points near the head's open border at the neck."""
    rim = np.unique(boundary_edges(head_world.faces))
    if not len(rim):
        return np.zeros(len(places), bool)
    return nearest(PointTree.of(head_world.vertices[rim]), places, within=within_mm)[0] < within_mm


def below_head(head_world: Mesh, places: Float[np.ndarray, "n 3"]) -> Bool[np.ndarray, " n"]:
    """Returns a mask of the points whose nearest head vertex lies near the head's open border."""
    vertices = head_world.vertices[::EVERY]
    return near_rim(head_world, vertices)[nearest(PointTree.of(vertices), places)[1]]
