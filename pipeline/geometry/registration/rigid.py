"""Fits rigid motions and similarities of points to a surface. Gauss-Newton steps minimise the distances along the
normals (Chen and Medioni 1992), over a motion and, if requested, shape coefficients. A search from many starts uses
trimmed iterated closest points, by position and normal (Besl and McKay 1992, https://doi.org/10.1109/34.121791): few
iterations from all starts, more from the best ones. Procrustes analysis (the paper's section 4.2, eq. 3) is also
possible with a covariance."""

from collections.abc import Callable
from dataclasses import dataclass

import numpy as np
from jaxtyping import Float, Int
from scipy.spatial import KDTree

from pipeline.geometry.surface_index import SurfaceIndex
from rig.geometry import RigidTransform, Similarity, cross_matrix, nearest_rotation, rotation_from_vector

SCALE_SPREAD = 0.02  # prior on log scale: rigs are metric, and what is left is calibration's error of scale
ITERATIONS = 20
SURFACE_POINTS = 6000  # of the surface: 6 mm apart on a head
TURN_MM = 30.0  # distance that a difference of one between unit normals counts as
Points = Float[np.ndarray, "n 3"]


@dataclass(frozen=True, slots=True, eq=False)
class Counterparts:
    """Holds the correspondences of n points on a surface: the unit normals there, the distances along them (mm), and
    weights, 0 for a point without correspondence. ``reach_mm`` is the largest distance of a correspondence in the next
    step."""

    normals: Points
    ahead_mm: Float[np.ndarray, " n"]
    weights: Float[np.ndarray, " n"]
    reach_mm: float


Meet = Callable[[Similarity, Points, float], Counterparts | None]


def fit_motion(
    points: Points, meet: Meet, start: Similarity, *, reach_mm: float, steps: int, still_mm: float, scale: bool = False
) -> Similarity | None:
    """Fits points to a surface by a rigid motion or, with ``scale``, a similarity. The callback ``meet`` finds the
    surface correspondences of the moved points within a distance, which is ``reach_mm`` in the first step. Returns None
    as soon as ``meet`` returns None, which means too few correspondences. The iteration ends after a step that moves
    every point by less than ``still_mm``, unless ``meet`` shrinks the distance."""
    motion = start
    for _ in range(steps):
        there = motion.apply(points)
        met = meet(motion, there, reach_mm)
        if met is None:
            return None
        centre = np.average(there, axis=0, weights=met.weights)
        root = np.sqrt(met.weights / met.weights.sum())
        columns = motion_columns(there - centre, met.normals, scale=scale)
        step = np.linalg.lstsq(columns * root[:, None], met.ahead_mm * root, rcond=None)[0]
        moved = motion_about(centre, step)
        motion = moved @ motion
        if met.reach_mm >= reach_mm and float(np.abs(moved.apply(there) - there).max()) < still_mm:
            break
        reach_mm = met.reach_mm
    return motion


def motion_columns(arms: Points, normals: Points, *, scale: bool = False) -> Float[np.ndarray, "n p"]:
    """Returns the derivatives of the points' displacement along normals by a rotation (rad) about the origin of
    ``arms``, by a translation (mm) and, with ``scale``, by the logarithm of the scale."""
    columns = [np.cross(arms, normals), normals]
    if scale:
        columns.append((arms * normals).sum(axis=1, keepdims=True))
    return np.concatenate(columns, axis=1)


def motion_about(centre: Float[np.ndarray, " 3"], step: Float[np.ndarray, " p"]) -> Similarity:
    """Converts a step in the unknowns of ``motion_columns`` to a motion about ``centre``."""
    turn, scale = rotation_from_vector(step[:3]), float(np.exp(step[6])) if len(step) > 6 else 1.0
    return Similarity(scale, turn, centre + step[3:6] - scale * turn @ centre)


def solve_with_prior(
    columns: Float[np.ndarray, "n p"],
    ahead: Float[np.ndarray, " n"],
    information: Float[np.ndarray, " n"],
    prior: Float[np.ndarray, " p"],
    state: Float[np.ndarray, " p"],
    *,
    precision: type = np.float64,
    ridge: float = 0.0,
) -> Float[np.ndarray, " p"]:
    """Returns the least-squares step of the unknowns from ``state`` for the distances ``ahead``, under independent
    Gaussian priors with mean 0 and information ``prior``.

    Single ``precision`` halves the time and suffices if the prior is strong. ``ridge`` bounds unknowns without a prior:
    it is added to their information, as a multiple of the mean information."""
    root = np.sqrt(information)
    weighted = (columns * root[:, None]).astype(precision)
    system = (weighted.T @ weighted).astype(float)
    diagonal = np.einsum("ii->i", system)
    diagonal += prior
    diagonal += np.where(prior > 0.0, 0.0, ridge * diagonal.mean())
    return np.linalg.solve(system, weighted.T.astype(float) @ (ahead * root) - prior * state)


@dataclass(frozen=True, slots=True)
class Round:
    """Holds the limits of one round of the search: numbers of points and iterations, fraction of points, number of
    starts."""

    points: int
    iterations: int
    share: float  # of the points, the nearest, that count: a scan may lack all but the face
    kept: int


ROUNDS = (Round(50, 6, 0.7, 60), Round(100, 12, 0.7, 16), Round(240, 25, 0.6, 8))


def search_motions(
    points: Float[np.ndarray, "n 3"],
    normals: Float[np.ndarray, "n 3"],
    surface: Float[np.ndarray, "m 3"],
    facing: Float[np.ndarray, "m 3"],
    *,
    turns: Float[np.ndarray, "t 3 3"],
    places: Float[np.ndarray, "p 3"],
) -> list[Similarity]:
    """Returns the best starting motions from points to a surface; the points must be in random order. Every combination
    of a rotation with a position of the points' centre is tried with few points; the best motions continue with more
    points. ``normals`` are the unit normals of the points, ``facing`` those of the sampled ``surface``."""
    middle = points.mean(axis=0)
    points = points - middle
    tree = KDTree(np.concatenate([surface, TURN_MM * facing], axis=1))
    rotations, translations = np.repeat(turns, len(places), axis=0), np.tile(places, (len(turns), 1))
    for stage in ROUNDS:
        some, facing_mm = points[: stage.points], TURN_MM * normals[: stage.points]
        kept, means = int(stage.share * len(some)), np.full(len(rotations), np.inf)
        for _ in range(stage.iterations):  # of all starts at once
            there = np.einsum("kij,nj->kni", rotations, some) + translations[:, None]
            turned = np.einsum("kij,nj->kni", rotations, facing_mm)
            far, near = map(np.asarray, tree.query(np.concatenate([there, turned], axis=2)))
            order = np.argsort(far, axis=1)[:, :kept]
            means = np.take_along_axis(far, order, axis=1).mean(axis=1)
            source, target = some[order], surface[np.take_along_axis(near, order, axis=1)]
            source_mean, target_mean = source.mean(axis=1), target.mean(axis=1)
            moments = np.einsum("kni,knj->kij", target - target_mean[:, None], source - source_mean[:, None])
            rotations = np.stack([nearest_rotation(moment) for moment in moments])
            translations = target_mean - np.einsum("kij,kj->ki", rotations, source_mean)
        best = np.argsort(means)[: stage.kept]
        rotations, translations = rotations[best], translations[best]
    return [Similarity(1.0, r, t - r @ middle) for r, t in zip(rotations, translations, strict=True)]


def draw_surface_points(
    surface: SurfaceIndex, rng: np.random.Generator
) -> tuple[Float[np.ndarray, "n 3"], Float[np.ndarray, "n 3"]]:
    """Returns random points on a surface, uniform by area (centroids of triangles), and their normals."""
    corners = surface.corners
    area = np.linalg.norm(np.cross(corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0]), axis=1)
    chosen = draw_rows(area, SURFACE_POINTS, rng)
    return corners[chosen].mean(axis=1), surface.normals(chosen)


def draw_rows(weights: Float[np.ndarray, " n"], count: int, rng: np.random.Generator) -> Int[np.ndarray, " k"]:
    """Returns at most ``count`` different indices, drawn with probabilities proportional to their weights."""
    return rng.choice(len(weights), min(count, int((weights > 0).sum())), replace=False, p=weights / weights.sum())


def procrustes(
    source: Float[np.ndarray, "n 3"], target: Float[np.ndarray, "n 3"], weights: Float[np.ndarray, " n"] | None = None
) -> Similarity:
    """Computes the full ordinary Procrustes alignment: the similarity T that minimises the paper's eq. (3), ``sum_j w_j
    |target_j - T(source_j)|^2``.

    The method is from Dryden and Mardia, Statistical Shape Analysis, section 7.2; a test of the determinant excludes
    mirror images. Raises ValueError if the points lie on a line and so determine no rotation."""
    share = np.full(len(source), 1.0 / len(source)) if weights is None else weights / weights.sum()
    source_mean, target_mean = share @ source, share @ target
    centred, wanted = source - source_mean, target - target_mean
    covariance = (wanted * share[:, None]).T @ centred
    singular = np.linalg.svd(covariance, compute_uv=False)
    if singular[1] <= 1e-12 * singular[0]:
        raise ValueError("points on a line determine no rotation")
    rotation = nearest_rotation(covariance)
    scale = float((rotation * covariance).sum() / (share @ (centred**2).sum(axis=1)))
    return Similarity(scale, rotation, target_mean - scale * rotation @ source_mean)


def rigid_procrustes(source: Float[np.ndarray, "n 3"], target: Float[np.ndarray, "n 3"]) -> RigidTransform:
    """Computes the rigid motion that minimises the paper's eq. (3); it has no scale, because a scale would overfit few
    points."""
    rotation = procrustes(source, target).rotation
    return RigidTransform(rotation, target.mean(axis=0) - rotation @ source.mean(axis=0))


def generalised_procrustes(
    source: Float[np.ndarray, "n 3"],
    target: Float[np.ndarray, "n 3"],
    source_covariance: Float[np.ndarray, "p p"],
    target_covariance: Float[np.ndarray, "p p"],
    *,
    start: Similarity,
    scale_spread: float = SCALE_SPREAD,
) -> Similarity:
    """Computes the most likely similarity T for ``target = T(source + e) + f``, where the errors e (head frame) and f
    (world frame) are correlated between points.

    Iterates generalised least squares from ``start`` with the residual covariance ``s^2 R C R^T + F`` of the last
    estimate. The logarithm of the scale s has the prior N(0, ``scale_spread``^2)."""
    scale, rotation, translation = start.scale, start.rotation, start.translation
    for _ in range(ITERATIONS):
        turn = scale * np.kron(np.eye(len(source)), rotation)
        whiten = np.linalg.inv(np.linalg.cholesky(turn @ source_covariance @ turn.T + target_covariance))
        turned = scale * source @ rotation.T
        residual = (target - turned - translation).ravel()
        # columns: left turn about the head's origin, shift, log scale
        shift = np.tile(np.eye(3), (len(turned), 1, 1))
        jacobian = np.concatenate([-cross_matrix(turned), shift, turned[:, :, None]], axis=2).reshape(-1, 7)
        rows = np.concatenate([whiten @ jacobian, np.eye(7)[6:] / scale_spread])
        step = np.linalg.lstsq(rows, np.append(whiten @ residual, -np.log(scale) / scale_spread), rcond=None)[0]
        rotation = rotation_from_vector(step[:3]) @ rotation
        translation = translation + step[3:6]
        scale *= float(np.exp(step[6]))
        if np.linalg.norm(step[:3]) < 1e-10 and np.linalg.norm(step[3:6]) < 1e-8:
            break
    return Similarity(scale, rotation, translation)


def block_diagonal(blocks: Float[np.ndarray, "n 3 3"]) -> Float[np.ndarray, "p p"]:
    """Returns the joint covariance of points with independent errors, from the covariance of each point."""
    whole = np.zeros((len(blocks), 3, len(blocks), 3))
    whole[np.arange(len(blocks)), :, np.arange(len(blocks)), :] = blocks
    return whole.reshape(3 * len(blocks), -1)
