"""Aligns the head to feature points (the paper's section 4.2): estimates the similarity ``T(x) = s (R x + t')`` from
the head frame to the world.

The input is picked points, the rig and the head model. The output of the alignment is world_from_head, and the residual
of each point. Step 1 is the paper's: full ordinary Procrustes analysis from the mean head's landmarks to the
triangulated points, which minimises eq. (3). The alignment departs from the paper in two ways.

First, a gross outlier among the points (right and left exchanged) must not rotate the head. The head is therefore
aligned to every triple of points, and the alignment with which most points agree decides which points are used.

Second, eq. (3) gives all points the same weight and assumes that the subject has the mean head's shape. Step 2
therefore weights each residual by the covariances of the triangulated point and of the model's landmarks: a wide jaw is
correlated with wide cheeks, and must not rotate the head.

``pipeline.geometry.registration.rigid`` computes the paper's alignment.
"""

from collections.abc import Mapping
from dataclasses import dataclass
from itertools import combinations

import numpy as np
from jaxtyping import Bool, Float

from pipeline.alignment.feature_points import features_as_wholes, locate_features
from pipeline.geometry.registration.rigid import block_diagonal, generalised_procrustes, procrustes, rigid_procrustes
from pipeline.head_model.landmarks import LANDMARK_NOISE_MM, NAMES, SEVEN_POINTS, mirrored
from pipeline.head_model.model import HeadModel
from pipeline.multiview.triangulation import CLICK_NOISE_PX, TriangulatedPoint
from rig.capture import Features
from rig.errors import EigenheadError
from rig.geometry import Similarity
from rig.messages.message import Message, compose, some_of
from rig.rig import Rig

Points = Float[np.ndarray, "n 3"]

MIN_POINTS = 3
MIN_AGREED_SIDES = 0.85  # share of points that agree when right and left are correct
MIN_TRIANGLE_MM = 5.0  # rms distance from the best line; less leaves the turn about that line to the noise
OUTLIER_SIGMAS = 4.0  # of a point's own expected spread; 1 in 1,000 good points is lost (chi-square, 3 degrees)


class WrongFeatures(EigenheadError):
    """Reports feature points of which most are wrong in the same way, with the kind of fault."""

    def __init__(self, fault: Message) -> None:
        super().__init__(compose("of-features", fault=fault))


class TooFewFeatures(EigenheadError):
    """Reports feature points that do not determine an alignment."""

    def __init__(self, usable: Mapping[str, TriangulatedPoint], why: Message, remarks: tuple[Message, ...]) -> None:
        counts = [compose("landmark-views", name=n, views=len(point.residuals_px)) for n, point in usable.items()]
        usable_told = counts or compose("nothing-usable")
        if remarks:
            super().__init__(
                compose("too-few-features-remarks", why=why, needed=MIN_POINTS, usable=usable_told, remarks=remarks)
            )
        else:
            super().__init__(compose("too-few-features", why=why, needed=MIN_POINTS, usable=usable_told))


@dataclass(frozen=True, slots=True, eq=False)
class FeatureAlignment:
    """Holds the pose ``world_from_head`` and all points of the alignment, including outliers."""

    world_from_head: Similarity
    points: Mapping[str, TriangulatedPoint]
    remarks: tuple[Message, ...]


def align_by_features(model: HeadModel, features: Features, rig: Rig) -> FeatureAlignment:
    """Aligns the mean head to picked feature points: rejects outliers, minimises the paper's eq. (3), then weights the
    points by their covariance. Raises TooFewFeatures or WrongFeatures."""
    if features.keys().isdisjoint(NAMES):
        raise WrongFeatures(compose("features-of-no-landmark", names=some_of([*features]), known=SEVEN_POINTS))
    whole = features_as_wholes(features, rig, noise_px=CLICK_NOISE_PX)
    if whole is not None:
        raise WrongFeatures(whole)
    located = locate_features(features, rig, noise_px=CLICK_NOISE_PX)
    unknown = [
        compose("feature-not-of-model", name=name, model=model.name)
        for name in located.points
        if name not in model.landmarks
    ]
    points = {name: point for name, point in located.points.items() if name in model.landmarks}
    remarks = (*located.remarks, *unknown)
    if len(points) < MIN_POINTS:
        raise TooFewFeatures(points, compose("points-usable", count=len(points)), remarks)
    names = list(points)
    target = np.stack([point.position_world for point in points.values()])
    source, spread = landmark_statistics(model, names, LANDMARK_NOISE_MM)
    noise = np.stack([point.covariance for point in points.values()])
    expected = np.sqrt((_diagonal_blocks(spread) + noise).trace(axis1=1, axis2=2) / 3.0)
    kept = consensus(source, target, expected)
    if kept is None:
        raise TooFewFeatures(points, compose("points-on-line"), remarks)
    if _sides_exchanged(model, names, target, noise, kept):
        raise WrongFeatures(compose("features-sides-exchanged"))
    rows = np.flatnonzero(np.repeat(kept, 3))
    aligned = generalised_procrustes(
        source[kept],
        target[kept],
        spread[np.ix_(rows, rows)],
        block_diagonal(noise[kept]),
        start=procrustes(source[kept], target[kept]),
    )
    distances = np.linalg.norm(target - aligned.apply(source), axis=1)
    remarks += tuple(
        compose("feature-off", name=name, distance_mm=distance)
        for name, distance, keep in zip(names, distances, kept, strict=True)
        if not keep
    )
    return FeatureAlignment(aligned, points, remarks)


def _sides_exchanged(
    model: HeadModel, names: list[str], target: Points, noise: Float[np.ndarray, "n 3 3"], kept: Bool[np.ndarray, " n"]
) -> bool:
    """Returns whether most points agree with the mean head only after right and left are exchanged in all names."""
    others = [mirrored(name) for name in names]
    if float(kept.mean()) >= MIN_AGREED_SIDES or others == names or not all(name in model.landmarks for name in others):
        return False
    source, spread = landmark_statistics(model, others, LANDMARK_NOISE_MM)
    expected = np.sqrt((_diagonal_blocks(spread) + noise).trace(axis1=1, axis2=2) / 3.0)
    found = consensus(source, target, expected)
    return found is not None and float(found.mean()) >= MIN_AGREED_SIDES and bool(found.sum() > kept.sum() + 1)


def landmark_statistics(model: HeadModel, names: list[str], noise_mm: float) -> tuple[Points, Float[np.ndarray, "p p"]]:
    """Returns the mean head's landmarks (head frame, mm) and their covariance over the population (mm^2, p = 3 n).

    ``noise_mm`` is the standard deviation between a person's and the model's position of the same landmark.
    """
    vertices = np.array([model.landmarks[name] for name in names])
    modes = model.basis("full", len(model.modes), vertices).reshape(len(model.modes), -1).astype(float)
    mean = model.levels["full"].operator[vertices] @ model.mean.astype(float)
    return mean, modes.T @ modes + noise_mm**2 * np.eye(modes.shape[1])


def consensus(source: Points, target: Points, expected_mm: Float[np.ndarray, " n"]) -> Bool[np.ndarray, " n"] | None:
    """Returns a mask of the points that agree with one rigid alignment; None if no three points span a triangle.

    The rigid alignment of every three points is tried, and the alignment with the smallest truncated sum of squared
    residuals is chosen. The chosen alignment is refitted to the agreeing points; the result is all points within
    ``OUTLIER_SIGMAS`` of it. 26 points make 2,600 triples, which take 0.3 s."""
    best, agreed = np.inf, None
    for triple in combinations(range(len(source)), MIN_POINTS):
        chosen = list(triple)
        if min(flatness(source[chosen]), flatness(target[chosen])) < MIN_TRIANGLE_MM:
            continue
        fitted = rigid_procrustes(source[chosen], target[chosen])
        squared = ((target - fitted.apply(source)) ** 2).sum(axis=1) / expected_mm**2
        cost = float(np.minimum(squared, OUTLIER_SIGMAS**2).sum())
        if cost < best:
            best, agreed = cost, squared < OUTLIER_SIGMAS**2
            agreed[chosen] = True
    for _ in range(3) if agreed is not None else ():
        fitted = rigid_procrustes(source[agreed], target[agreed])
        near = ((target - fitted.apply(source)) ** 2).sum(axis=1) < (OUTLIER_SIGMAS * expected_mm) ** 2
        if near.sum() >= MIN_POINTS and flatness(source[near]) >= MIN_TRIANGLE_MM:
            agreed = near
    return agreed


def flatness(points: Points) -> float:
    """Returns the RMS distance (mm) of points from their best-fitting line."""
    singular = np.linalg.svd(points - points.mean(axis=0), compute_uv=False)
    return float(np.hypot(singular[1], singular[2]) / np.sqrt(len(points)))


def _diagonal_blocks(covariance: Float[np.ndarray, "p p"]) -> Float[np.ndarray, "n 3 3"]:
    count = len(covariance) // 3
    blocks = covariance.reshape(count, 3, count, 3)
    return blocks[np.arange(count), :, np.arange(count), :]
