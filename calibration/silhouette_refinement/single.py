"""Refines cameras by the silhouettes of a single capture, for calibrations from photographs alone.

No other capture can be held out, so pairs of cameras are. Every view takes part in pairs on both sides, so held-out
pairs judge poses that they did not influence; but a fault of a view's mask is judged by the same mask."""

from collections.abc import Mapping
from dataclasses import dataclass

import numpy as np

from calibration.adjustment.gauge import image_distance
from calibration.silhouette_refinement.refine import (
    FOLDS,
    GAIN_SIGMAS,
    PRIOR_PX,
    Pairs,
    gain_of,
    minimise_tangencies,
    noise_of,
    residuals,
    robust_rms,
)
from pipeline.imaging.silhouette import Silhouette
from rig.messages.message import Message, compose
from rig.rig import Rig

VIEWS_LEAST = 8  # 28 pairs; with fewer some camera would have no pairs left once a fifth is held out


@dataclass(frozen=True, slots=True, eq=False)
class SingleRefinement:
    """Holds the result of a refinement by one capture.

    ``rig`` is ``proposed`` if it is ``kept``, otherwise the start; ``reason`` says why. ``change_px`` is the RMS motion
    (2D) of the image of the subject's region, of the median camera."""

    rig: Rig
    proposed: Rig
    kept: bool
    change_px: float
    reason: Message


def refine_one(capture: Mapping[str, Silhouette], rig: Rig) -> SingleRefinement | None:
    """Refines extrinsics by the silhouettes of one capture.

    The result is kept if pairs of cameras agree better while they are held out, a fifth of them at a time. Returns None
    if fewer than ``VIEWS_LEAST`` views have a usable silhouette.
    """
    usable = [name for name in rig.names if name in capture and capture[name].quality.usable]
    if len(usable) < VIEWS_LEAST:
        return None
    proposed = minimise_tangencies([capture], rig, focal=False, prior_px=PRIOR_PX, heads=None)
    parts = []
    for fold in range(FOLDS):
        held, others = _pairs(usable, fold, inside=True), _pairs(usable, fold, inside=False)
        without = minimise_tangencies([capture], rig, focal=False, prior_px=PRIOR_PX, heads=None, pairs=others)
        parts.append([residuals([capture], candidate, held).px for candidate in (rig, without)])
    before, after = (np.concatenate(side) for side in zip(*parts, strict=True))
    noise = noise_of(after)
    gain, deviation = gain_of(before, after, noise)
    accepted = gain > GAIN_SIGMAS * deviation
    reason = compose(
        "refinement-pairs-shrink" if accepted else "refinement-pairs-stay",
        before_px=robust_rms(before, noise),
        after_px=robust_rms(after, noise),
        equations=len(after),
        sigmas=gain / max(deviation, 1e-9),
    )
    change_px = float(np.median(image_distance(proposed, rig)))
    return SingleRefinement(proposed if accepted else rig, proposed, accepted, change_px, reason)


def _pairs(names: list[str], fold: int, *, inside: bool) -> Pairs:
    """Returns a test whether a pair of cameras is in a fold (``inside``) or not. All cameras have pairs in each."""
    index_of = {name: index for index, name in enumerate(names)}
    return lambda pair: (sum(index_of[name] for name in pair) % FOLDS == fold) == inside
