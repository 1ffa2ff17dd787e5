"""Alignment from feature points (section 4.2): the similarity ``T(x) = s (R x + t')`` that takes the head to the world.

Enters: picked points, the rig, the model. Leaves: world_from_head, with what each point says against it.

Step 1 is the paper's: full ordinary Procrustes, the minimum of eq. (3), from the mean head's landmarks to the
triangulated points. Two departures:
- A gross outlier among the points (right and left confused) must not turn the head. Every triple of points is tried;
  the alignment that the points contradict least decides which of them stay.
- Eq. (3) trusts all points alike and takes the subject for the mean head. Step 2 weighs each residual with the
  covariance of the triangulated point and with the model's own covariance of its landmarks: a wide jaw is expected to
  vary with the cheeks, not to turn the head. The paper's alignment is ``FeatureAlignment.procrustes``.
"""

from collections.abc import Mapping
from dataclasses import dataclass
from itertools import combinations

import numpy as np
from jaxtyping import Bool, Float

from pipeline.eigenheads.model import HeadModel
from pipeline.features import locate_features
from pipeline.settings import AlignmentSettings
from pipeline.triangulation import TriangulatedPoint
from rig.capture import Features
from rig.errors import EigenheadError
from rig.geometry import RigidTransform, Similarity, cross_matrix, rotation_from_vector
from rig.layout import Rig

POINTS_LEAST = 3
TRIANGLE_LEAST_MM = 5.0  # rms distance from the best line; less leaves the turn about that line to the noise
OUTLIER_SIGMAS = 4.0  # of a point's own expected spread; 1 in 1,000 good points is lost (chi-square, 3 degrees)
SCALE_SPREAD = 0.02  # prior on log scale: rigs are metric, and what is left is calibration's error of scale
ITERATIONS = 20


class TooFewFeatures(EigenheadError):
    """Feature points that determine no alignment."""

    def __init__(self, usable: Mapping[str, TriangulatedPoint], why: str, remarks: tuple[str, ...]) -> None:
        counts = ", ".join(f"{name} in {len(point.residuals_px)} views" for name, point in usable.items()) or "none"
        told = "".join(f"; {remark}" for remark in remarks)
        super().__init__(
            f"the feature points determine no alignment: {why}. At least {POINTS_LEAST} landmarks of the model "
            f"that are not on a line are needed, each in 2 views; usable are: {counts}{told}. Pick more points, "
            "or remove features.json to let the silhouettes decide"
        )


@dataclass(frozen=True, slots=True, eq=False)
class FeatureAlignment:
    """``world_from_head``, the paper's ``procrustes`` of the same points, and the evidence.

    ``residuals_mm``: distance of every point from the mean head's landmark, outliers too; ``used`` says which spoke.
    """

    world_from_head: Similarity
    procrustes: Similarity
    points: Mapping[str, TriangulatedPoint]
    residuals_mm: Mapping[str, float]
    used: Mapping[str, bool]
    remarks: tuple[str, ...]


def align_to_features(model: HeadModel, features: Features, rig: Rig, settings: AlignmentSettings) -> Similarity:
    """world_from_head of ``feature_alignment``. Raises TooFewFeatures."""
    return feature_alignment(model, features, rig, settings).world_from_head


def feature_alignment(model: HeadModel, features: Features, rig: Rig, settings: AlignmentSettings) -> FeatureAlignment:
    """Alignment to picked points: outliers found, eq. (3) minimised, then weighed. Raises TooFewFeatures."""
    located = locate_features(features, rig, noise_px=settings.feature_noise_px)
    unknown = [
        f"feature {name} is no landmark of model {model.name}" for name in located.points if name not in model.landmarks
    ]
    points = {name: point for name, point in located.points.items() if name in model.landmarks}
    remarks = (*located.remarks, *unknown)
    if len(points) < POINTS_LEAST:
        raise TooFewFeatures(points, f"{len(points)} points are usable", remarks)
    names = list(points)
    target = np.stack([point.position_world for point in points.values()])
    source, spread = landmark_statistics(model, names, settings.landmark_noise_mm)
    noise = np.stack([point.covariance for point in points.values()])
    expected = np.sqrt((_own_blocks(spread) + noise).trace(axis1=1, axis2=2) / 3.0)
    kept = consensus(source, target, expected)
    if kept is None:
        raise TooFewFeatures(points, "they lie on one line", remarks)
    procrustes_only = procrustes(source[kept], target[kept])
    rows = np.flatnonzero(np.repeat(kept, 3))
    aligned = generalised_procrustes(
        source[kept], target[kept], spread[np.ix_(rows, rows)], noise[kept], start=procrustes_only
    )
    distances = np.linalg.norm(target - aligned.apply(source), axis=1)
    remarks += tuple(
        f"feature {name} lies {distance:.0f} mm off what the other points say: left out"
        for name, distance, keep in zip(names, distances, kept, strict=True)
        if not keep
    )
    residuals = dict(zip(names, distances.tolist(), strict=True))
    used = dict(zip(names, kept.tolist(), strict=True))
    return FeatureAlignment(aligned, procrustes_only, points, residuals, used, remarks)


def landmark_statistics(
    model: HeadModel, names: list[str], noise_mm: float
) -> tuple[Float[np.ndarray, "n 3"], Float[np.ndarray, "p p"]]:
    """The mean head's landmarks (head frame, mm) and their covariance over the population (mm^2, p = 3 n).

    ``noise_mm`` is what a person's idea of a landmark and the model's differ by.
    """
    vertices = np.array([model.landmarks[name] for name in names])
    modes = model.basis("full", len(model.modes), vertices).reshape(len(model.modes), -1).astype(float)
    mean = model.levels["full"].operator[vertices] @ model.mean.astype(float)
    return mean, modes.T @ modes + noise_mm**2 * np.eye(modes.shape[1])


def procrustes(
    source: Float[np.ndarray, "n 3"], target: Float[np.ndarray, "n 3"], weights: Float[np.ndarray, " n"] | None = None
) -> Similarity:
    """Full ordinary Procrustes: the similarity T that minimises eq. (3), ``sum_j w_j |target_j - T(source_j)|^2``.

    Dryden and Mardia, Statistical Shape Analysis, section 7.2; the determinant keeps a mirror image out. Raises
    ValueError where the points determine no rotation (all on a line).
    """
    share = np.full(len(source), 1.0 / len(source)) if weights is None else weights / weights.sum()
    source_mean, target_mean = share @ source, share @ target
    centred, wanted = source - source_mean, target - target_mean
    u, singular, vt = np.linalg.svd((wanted * share[:, None]).T @ centred)
    if singular[1] <= 1e-12 * singular[0]:
        raise ValueError("points on a line determine no rotation")
    signs = np.array([1.0, 1.0, np.sign(np.linalg.det(u @ vt))])
    rotation = (u * signs) @ vt
    scale = float(singular @ signs / (share @ (centred**2).sum(axis=1)))
    return Similarity(scale, rotation, target_mean - scale * rotation @ source_mean)


def generalised_procrustes(
    source: Float[np.ndarray, "n 3"],
    target: Float[np.ndarray, "n 3"],
    source_covariance: Float[np.ndarray, "p p"],
    target_covariances: Float[np.ndarray, "n 3 3"],
    *,
    start: Similarity,
    scale_spread: float = SCALE_SPREAD,
) -> Similarity:
    """Maximum likelihood of ``target = T(source + e) + f``: ``e`` correlated over the points, ``f`` independent.

    Iterated generalised least squares from ``start``: the residual's covariance is ``s^2 R C R^T + F``, taken at the
    last estimate. log s has the prior N(0, ``scale_spread``^2).
    """
    scale, rotation, translation = start.scale, start.rotation, start.translation
    noise = _block_diagonal(target_covariances)
    for _ in range(ITERATIONS):
        turn = scale * np.kron(np.eye(len(source)), rotation)
        whiten = np.linalg.inv(np.linalg.cholesky(turn @ source_covariance @ turn.T + noise))
        turned = scale * source @ rotation.T
        residual = (target - turned - translation).ravel()
        # columns: left turn about the head's origin, shift, log scale
        jacobian = np.concatenate([np.concatenate([-cross_matrix(x), np.eye(3), x[:, None]], axis=1) for x in turned])
        rows = np.concatenate([whiten @ jacobian, np.eye(7)[6:] / scale_spread])
        step = np.linalg.lstsq(rows, np.append(whiten @ residual, -np.log(scale) / scale_spread), rcond=None)[0]
        rotation = rotation_from_vector(step[:3]) @ rotation
        translation = translation + step[3:6]
        scale *= float(np.exp(step[6]))
        if np.linalg.norm(step[:3]) < 1e-10 and np.linalg.norm(step[3:6]) < 1e-8:
            break
    return Similarity(scale, rotation, translation)


def consensus(
    source: Float[np.ndarray, "n 3"], target: Float[np.ndarray, "n 3"], expected_mm: Float[np.ndarray, " n"]
) -> Bool[np.ndarray, " n"] | None:
    """Which points belong together; None where no triple of them spans a triangle.

    Of the rigid alignments through every triple, the one with the least truncated sum of squared residuals wins; points
    within OUTLIER_SIGMAS of the alignment of all that agree are kept. 26 points make 2,600 triples: 0.3 s.
    """
    best, agreed = np.inf, None
    for triple in combinations(range(len(source)), POINTS_LEAST):
        chosen = list(triple)
        if min(_flatness(source[chosen]), _flatness(target[chosen])) < TRIANGLE_LEAST_MM:
            continue
        fitted = _rigid(source[chosen], target[chosen])
        squared = ((target - fitted.apply(source)) ** 2).sum(axis=1) / expected_mm**2
        cost = float(np.minimum(squared, OUTLIER_SIGMAS**2).sum())
        if cost < best:
            best, agreed = cost, squared < OUTLIER_SIGMAS**2
            agreed[chosen] = True
    for _ in range(3) if agreed is not None else ():
        fitted = _rigid(source[agreed], target[agreed])
        near = ((target - fitted.apply(source)) ** 2).sum(axis=1) < (OUTLIER_SIGMAS * expected_mm) ** 2
        if near.sum() >= POINTS_LEAST and _flatness(source[near]) >= TRIANGLE_LEAST_MM:
            agreed = near
    return agreed


def _rigid(source: Float[np.ndarray, "n 3"], target: Float[np.ndarray, "n 3"]) -> RigidTransform:
    # Scale stays 1 here: three points fit too well when they may also shrink.
    fitted = procrustes(source, target)
    return RigidTransform(fitted.rotation, target.mean(axis=0) - fitted.rotation @ source.mean(axis=0))


def _flatness(points: Float[np.ndarray, "n 3"]) -> float:
    """Rms distance (mm) from the line that fits best."""
    singular = np.linalg.svd(points - points.mean(axis=0), compute_uv=False)
    return float(np.hypot(singular[1], singular[2]) / np.sqrt(len(points)))


def _own_blocks(covariance: Float[np.ndarray, "p p"]) -> Float[np.ndarray, "n 3 3"]:
    count = len(covariance) // 3
    blocks = covariance.reshape(count, 3, count, 3)
    return blocks[np.arange(count), :, np.arange(count), :]


def _block_diagonal(blocks: Float[np.ndarray, "n 3 3"]) -> Float[np.ndarray, "p p"]:
    whole = np.zeros((len(blocks), 3, len(blocks), 3))
    whole[np.arange(len(blocks)), :, np.arange(len(blocks)), :] = blocks
    return whole.reshape(3 * len(blocks), -1)
