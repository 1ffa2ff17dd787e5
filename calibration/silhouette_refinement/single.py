"""Refinement by the silhouettes of one capture, as a calibration from photographs alone has it.

There is no other capture to hold out; pairs of cameras are held out instead. A view takes part in pairs on both sides,
so that a pair judges poses that it did not move, though a fault of a view's mask is judged by that mask.
"""

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

VIEWS_LEAST = 8  # 28 pairs: fewer leave a camera without pairs of its own once a fifth is held out


@dataclass(frozen=True, slots=True, eq=False)
class SingleRefinement:
    """``rig``: ``proposed`` where it is ``kept``, else the start; ``change_px``: RMS motion of the subject's region
    (2D), the median camera's; ``reason``: why it is kept or not."""

    rig: Rig
    proposed: Rig
    kept: bool
    change_px: float
    reason: Message


def refine_one(capture: Mapping[str, Silhouette], rig: Rig) -> SingleRefinement | None:
    """Refines extrinsics from one capture's silhouettes; kept if pairs of cameras, each fifth held out in its turn,
    agree. None where fewer than ``VIEWS_LEAST`` views have a silhouette of use."""
    seen = [name for name in rig.names if name in capture and capture[name].quality.usable]
    if len(seen) < VIEWS_LEAST:
        return None
    proposed = minimise_tangencies([capture], rig, focal=False, prior_px=PRIOR_PX, heads=None)
    parts = []
    for fold in range(FOLDS):
        held, others = _pairs(seen, fold, inside=True), _pairs(seen, fold, inside=False)
        without = minimise_tangencies([capture], rig, focal=False, prior_px=PRIOR_PX, heads=None, pairs=others)
        parts.append([residuals([capture], each, held).px for each in (rig, without)])
    before, after = (np.concatenate(side) for side in zip(*parts, strict=True))
    noise = noise_of(after)
    gain, deviation = gain_of(before, after, noise)
    kept = gain > GAIN_SIGMAS * deviation
    reason = compose(
        "refinement-pairs-shrink" if kept else "refinement-pairs-stay",
        before_px=robust_rms(before, noise),
        after_px=robust_rms(after, noise),
        equations=len(after),
        sigmas=gain / max(deviation, 1e-9),
    )
    change_px = float(np.median(image_distance(proposed, rig)))
    return SingleRefinement(proposed if kept else rig, proposed, kept, change_px, reason)


def _pairs(names: list[str], fold: int, *, inside: bool) -> Pairs:
    """Whether a pair is in a fold, or outside of it: every camera has some of its pairs in each."""
    place = {name: index for index, name in enumerate(names)}
    return lambda pair: (sum(place[name] for name in pair) % FOLDS == fold) == inside
