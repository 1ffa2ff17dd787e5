"""Triangulates feature points (the paper's section 4.2): computes world points from pixels picked in a few images.

A picked pixel may be wrong in one view (right and left exchanged, or a slip). With three views or more, the view that
contradicts the others is left out; with two contradicting views, the whole point is left out. Every omission is
reported."""

from collections.abc import Mapping
from dataclasses import dataclass

import numpy as np
from jaxtyping import Float
from scipy.special import chdtri

from pipeline.multiview.triangulation import NoPoint, TriangulatedPoint, triangulate
from rig.capture import Features
from rig.messages.message import Message, compose
from rig.rig import Rig

GROSS_NOISE = 3.0  # times the noise of a click: careless clicks must not count as points of another shot
MIN_JUDGED_VIEWS, MIN_JUDGED_POINTS = 3, 3  # of a point, whose contradiction is its own; and points
WRONG_SHARE, RIGHT_SHARE = 0.6, 0.8  # of the points
CONTRADICTION = 1e-4  # probability of a misfit this large by chance; one point in 10,000 is lost without need


@dataclass(frozen=True, slots=True, eq=False)
class LocatedFeatures:
    """Holds triangulated feature points (world frame, mm) by landmark name, and a remark for each omitted point or
    view."""

    points: Mapping[str, TriangulatedPoint]
    remarks: tuple[Message, ...] = ()


def locate_features(features: Features, rig: Rig, *, noise_px: float) -> LocatedFeatures:
    """Triangulates every landmark that was picked in two views or more. A point that cannot be triangulated is left out
    with a remark; no exception is raised."""
    points, remarks = {}, []
    for name, pixels in features.items():
        known = {camera: pixel for camera, pixel in pixels.items() if camera in rig}
        if len(known) < 2:
            remarks.append(compose("feature-view-missing", name=name, count=len(known)))
            continue
        try:
            point, dropped = _consistent(known, rig, noise_px)
        except NoPoint as error:
            remarks.append(compose("feature-left-out", name=name, reason=error.message))
            continue
        if point is None:
            remarks.append(compose("feature-contradictory", name=name))
            continue
        if dropped is not None:
            remarks.append(compose("feature-view-contradicts", name=name, camera=dropped))
        points[name] = point
    return LocatedFeatures(points, tuple(remarks))


def features_as_wholes(features: Features, rig: Rig, *, noise_px: float) -> Message | None:
    """Returns a fault that most points have in common: rows and columns exchanged, or points that belong to other
    pictures. Returns None if most points agree between their views, or if there are too few points to judge."""
    grossly = GROSS_NOISE * noise_px
    judged = {name: views for name, views in features.items() if len(views) >= MIN_JUDGED_VIEWS}
    wrong = len(judged) - len(locate_features(judged, rig, noise_px=grossly).points)
    if len(judged) < max(MIN_JUDGED_POINTS, len(features) / 2) or wrong < WRONG_SHARE * len(judged):
        return None
    exchanged = {name: {camera: at[::-1] for camera, at in views.items()} for name, views in judged.items()}
    right = len(locate_features(exchanged, rig, noise_px=grossly).points)
    if right >= RIGHT_SHARE * len(judged):
        return compose("features-transposed")
    return compose("features-of-other-pictures", count=wrong, all=len(judged))


def _consistent(
    pixels: Mapping[str, Float[np.ndarray, " 2"]], rig: Rig, noise_px: float
) -> tuple[TriangulatedPoint | None, str | None]:
    """Triangulates a point from all views or, if these contradict each other, from all but one; the second result is
    the name of the omitted view. Returns (None, None) if no such omission makes the views agree."""
    point = triangulate(pixels, rig, noise_px=noise_px)
    if _agrees(point, noise_px):
        return point, None
    if len(pixels) == 2:
        return None, None
    without = {
        name: triangulate({k: v for k, v in pixels.items() if k != name}, rig, noise_px=noise_px) for name in pixels
    }
    dropped = min(without, key=lambda name: without[name].misfit(noise_px))
    return (without[dropped], dropped) if _agrees(without[dropped], noise_px) else (None, None)


def _agrees(point: TriangulatedPoint, noise_px: float) -> bool:
    return point.misfit(noise_px) < float(chdtri(2 * len(point.residuals_px) - 3, CONTRADICTION))
