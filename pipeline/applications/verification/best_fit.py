"""Lays a measured head on its reference by a rigid motion: least squares of the distances to the surface.

The reference has its own frame. The motion starts from landmarks where both have them, else from a search: rotations
spread over all directions, with the head's middle at the middles of parts of the scan. Each start is improved by
iterations of closest points (Besl and McKay 1992, https://doi.org/10.1109/34.121791), and the one with the best fit of
the face wins. Gauss-Newton steps on distances along the reference's normals (Chen and Medioni 1992) over the face,
weighted by area, complete the motion. It is a standard's best fit, in which size has no part. The size error is found
afterwards by the same steps with a scale, and reported.
"""

from dataclasses import dataclass

import numpy as np
from jaxtyping import Bool, Float, Int
from scipy.cluster.vq import kmeans2
from scipy.spatial import KDTree
from scipy.spatial.transform import Rotation

from pipeline.applications.verification.measured import Measured
from pipeline.applications.verification.reference import Reference
from pipeline.geometry.surface_index import Hits
from pipeline.head_model.landmarks import stacked
from rig.errors import InputError
from rig.geometry import RigidTransform, Similarity, nearest_rotation, rigid_fit, rotation_from_vector

FAR_MM = 10.0  # from the reference: what is farther off has no counterpart on it
POINTS = 2000  # of the face, for the fit: six numbers need no more
SURFACE_POINTS = 6000  # of the reference, for the search: 6 mm apart on a head
PARTS = 4  # of the scan: shoulders or a stand move its middle away from the head's
TURN_MM = 30.0  # distance that a difference of one between unit normals counts as, in the search
FEW = 300  # of these points, for telling starts apart
MIN_MARKS = 3
MIN_COVERED = 0.3  # share of the face that must not lie at the scan's rim
STEPS = 30
STILL_MM = 3e-4  # a step whose points move by less is the last
NOT_THIS_MM = 5.0  # RMS over the face after the best fit: beyond any fault of a rig, and near any two heads' difference


@dataclass(frozen=True, slots=True)
class Round:
    """Holds one round of the search: how many points of the head and iterations of closest points it uses, and how many
    of the best starts it keeps."""

    points: int
    iterations: int
    share: float  # of the points, the nearest, that count: a scan may lack all but the face
    kept: int


ROUNDS = (Round(50, 6, 0.7, 60), Round(100, 12, 0.7, 16), Round(240, 25, 0.6, 8))


@dataclass(frozen=True, slots=True, eq=False)
class BestFit:
    """Holds the rigid motion that lays a head on its reference.

    ``start`` is "landmarks" or "search". ``rms_mm`` is the RMS distance after the rigid motion, over the ``points``
    that have a counterpart on the reference. ``scale`` is the size of the measured head relative to the reference, 1 =
    right.
    """

    reference_from_world: RigidTransform
    start: str
    rms_mm: float
    points: int
    scale: float


def best_fit(measured: Measured, reference: Reference) -> BestFit:
    """Finds the rigid motion that lays the face of a measured head on the reference. Raises InputError if the reference
    is no scan of this head."""
    face = measured.regions["face"]
    rng = np.random.default_rng(0)
    count = min(POINTS, int(face.sum()))
    picked = rng.choice(np.flatnonzero(face), count, replace=False)
    points, weights = measured.mesh_world.vertices[picked], measured.areas[picked]
    marks = [name for name in reference.landmarks if name in measured.landmarks]
    if len(marks) >= MIN_MARKS:
        start = "landmarks"
        motion = rigid_fit(stacked(measured.landmarks, marks), stacked(reference.landmarks, marks))
        starts = [Similarity.from_rigid(motion)]
    else:
        start, starts = "search", _searched(measured, reference, rng)
    if len(starts) > 1:
        tried = [_refined(points[:FEW], weights[:FEW], reference, motion, free_scale=False) for motion in starts]
        starts = [min(tried, key=lambda fit: fit[1])[0]]
    place, rms, used = _refined(points, weights, reference, starts[0], free_scale=False)
    if rms > NOT_THIS_MM:
        raise InputError(reference.name, [f"is no scan of the head in {measured.name}: after the best fit (from "
            f"{start}) the face is {rms:.1f} mm off. Is it this mannequin, in mm, and not mirrored?"])  # fmt: skip
    scaled, _, _ = _refined(points, weights, reference, place, free_scale=True)
    return BestFit(RigidTransform(place.rotation, place.translation), start, rms, used, 1.0 / scaled.scale)


def counted(hits: Hits, reference: Reference) -> Bool[np.ndarray, " n"]:
    """Tells which closest points are valid counterparts: near enough, and not at an open edge of the scan."""
    return (hits.distances < FAR_MM) & ~reference.beside(hits)


def _refined(
    points: Float[np.ndarray, "n 3"],
    weights: Float[np.ndarray, " n"],
    reference: Reference,
    start: Similarity,
    *,
    free_scale: bool,
) -> tuple[Similarity, float, int]:
    """Refines a motion by Gauss-Newton. Returns the motion, the RMS distance (mm) and the number of points with a
    counterpart. Far points weigh less at first (Geman and McClure), and the same as others in the end.

    The RMS counts a point that is far from the scan as ``FAR_MM`` off, so that a fit to a corner of it is no good one.
    """
    place, reach = start, 2.0 * FAR_MM
    for _ in range(STEPS):
        there = place.apply(points)
        hits = reference.index.closest(there)
        used = (hits.distances < max(FAR_MM, reach)) & ~reference.beside(hits)
        if used.sum() < 6 * 7:
            return place, np.inf, 0
        robust = (1.0 + (hits.distances / reach) ** 2) ** -2 if reach > 1.0 else np.ones(len(points))
        delta = _gauss_newton_step(there[used], hits, used, (weights * robust)[used], free_scale)
        centre = there[used].mean(axis=0)
        turn, scale = rotation_from_vector(delta[:3]), float(np.exp(delta[6])) if free_scale else 1.0
        moved = Similarity(scale, turn, centre + delta[3:6] - scale * turn @ centre)
        place = moved @ place
        still = float(np.abs(moved.apply(there) - there).max()) < STILL_MM
        if still and reach <= 1.0:
            break
        reach = max(0.5 * reach, 0.5)
    hits = reference.index.closest(place.apply(points))
    covered = ~reference.beside(hits)
    if covered.mean() < MIN_COVERED:
        return place, np.inf, 0
    off = np.minimum(hits.distances, FAR_MM)[covered]
    return place, float(np.sqrt(np.average(off**2, weights=weights[covered]))), int(counted(hits, reference).sum())


def _gauss_newton_step(
    points: Float[np.ndarray, "n 3"], hits: Hits, used: Bool[np.ndarray, " m"], weights: Float[np.ndarray, " n"],
    free_scale: bool,
) -> Float[np.ndarray, " p"]:  # fmt: skip
    """Returns the rotation about the points' middle, the translation (mm) and, if ``free_scale``, the logarithm of the
    scale."""
    normals = hits.normals[used]
    arms = points - points.mean(axis=0)
    columns = [np.cross(arms, normals), normals]
    if free_scale:
        columns.append((arms * normals).sum(axis=1, keepdims=True))
    jacobian = np.concatenate(columns, axis=1)
    residual = ((hits.points[used] - points) * normals).sum(axis=1)
    root = np.sqrt(weights / weights.sum())
    return np.linalg.lstsq(jacobian * root[:, None], residual * root, rcond=None)[0]


def _searched(measured: Measured, reference: Reference, rng: np.random.Generator) -> list[Similarity]:
    """Returns the best starting motions among all rotations: many are tried briefly with few points, fewer of them
    longer with more."""
    head = np.flatnonzero(~measured.regions["neck"])
    chosen = head[drawn(measured.areas[head], ROUNDS[-1].points, rng)]
    surface, facing = surface_points(reference, rng)
    parts = np.asarray(kmeans2(surface, PARTS, minit="++", rng=rng)[0])
    places = np.stack([surface.mean(axis=0), (surface.min(axis=0) + surface.max(axis=0)) / 2, *parts])
    turns = Rotation.create_group("I").as_matrix()  # no turn is farther than 45 degrees from one of the sixty
    points, normals = measured.mesh_world.vertices[chosen], measured.mesh_world.normals()[chosen]
    return search_motions(points, normals, surface, facing, turns=turns, places=places)


def search_motions(
    points: Float[np.ndarray, "n 3"],
    normals: Float[np.ndarray, "n 3"],
    surface: Float[np.ndarray, "m 3"],
    facing: Float[np.ndarray, "m 3"],
    *,
    turns: Float[np.ndarray, "t 3 3"],
    places: Float[np.ndarray, "p 3"],
) -> list[Similarity]:
    """Returns the best starting motions of points in random order: every turn with the points' middle at every place is
    tried briefly with few of them, fewer motions longer with more.

    Args:
        points: of the head, with their ``normals``.
        normals: unit.
        surface: points of the reference, with their normals ``facing``.
        facing: unit.
        turns: rotations to begin with.
        places: where the points' middle may lie.
    """
    middle = points.mean(axis=0)
    points = points - middle
    tree = KDTree(np.concatenate([surface, TURN_MM * facing], axis=1))
    rotations, translations = np.repeat(turns, len(places), axis=0), np.tile(places, (len(turns), 1))
    for stage in ROUNDS:
        some = slice(0, stage.points)
        means, rotations, translations = _closest_points(
            points[some], normals[some], surface, tree, rotations=rotations, translations=translations, stage=stage
        )
        best = np.argsort(means)[: stage.kept]
        rotations, translations = rotations[best], translations[best]
    return [Similarity(1.0, r, t - r @ middle) for r, t in zip(rotations, translations, strict=True)]


def _closest_points(
    points: Float[np.ndarray, "n 3"],
    normals: Float[np.ndarray, "n 3"],
    surface: Float[np.ndarray, "m 3"],
    tree: KDTree,
    *,
    rotations: Float[np.ndarray, "k 3 3"],
    translations: Float[np.ndarray, "k 3"],
    stage: Round,
) -> tuple[Float[np.ndarray, " k"], Float[np.ndarray, "k 3 3"], Float[np.ndarray, "k 3"]]:
    """Runs trimmed iterations of points closest in position and direction, for all starts at once. Returns the mean
    distance of the points that count, and the motions."""
    kept, means = int(stage.share * len(points)), np.full(len(rotations), np.inf)
    for _ in range(stage.iterations):
        there = np.einsum("kij,nj->kni", rotations, points) + translations[:, None]
        turned = TURN_MM * np.einsum("kij,nj->kni", rotations, normals)
        far, near = map(np.asarray, tree.query(np.concatenate([there, turned], axis=2)))
        order = np.argsort(far, axis=1)[:, :kept]
        means = np.take_along_axis(far, order, axis=1).mean(axis=1)
        source, target = points[order], surface[np.take_along_axis(near, order, axis=1)]
        source_mean, target_mean = source.mean(axis=1), target.mean(axis=1)
        moments = np.einsum("kni,knj->kij", target - target_mean[:, None], source - source_mean[:, None])
        rotations = np.stack([nearest_rotation(moment) for moment in moments])
        translations = target_mean - np.einsum("kij,kj->ki", rotations, source_mean)
    return means, rotations, translations


def surface_points(
    reference: Reference, rng: np.random.Generator
) -> tuple[Float[np.ndarray, "n 3"], Float[np.ndarray, "n 3"]]:
    """Returns points drawn over the reference by area (middles of triangles), and their normals."""
    corners = reference.index.corners
    area = np.linalg.norm(np.cross(corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0]), axis=1)
    chosen = drawn(area, SURFACE_POINTS, rng)
    return corners[chosen].mean(axis=1), reference.index.normals(chosen)


def drawn(weights: Float[np.ndarray, " n"], count: int, rng: np.random.Generator) -> Int[np.ndarray, " k"]:
    """Returns at most ``count`` different rows, drawn by their weights."""
    return rng.choice(len(weights), min(count, int((weights > 0).sum())), replace=False, p=weights / weights.sum())
