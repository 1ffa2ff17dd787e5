"""Estimates three things from the residuals of a stage: the noise of the outlines, where hair or clothes form them, and
whether the head is bald."""

from dataclasses import replace

import numpy as np
from jaxtyping import Int

from pipeline.contour_fit.clutter import CLUTTER_PX, CLUTTER_SIGMAS, find_clutter
from pipeline.contour_fit.problem import FIRST_NOISE_PX, ContourProblem, Stage, StageEvidence, State
from pipeline.contour_fit.rim import Rim
from pipeline.contour_fit.rim_term import observed_rim

BARE_PX = 2.0  # cranium, ears and neck agree with the input to this after a fit to the whole head ...
BARE_SHARE = 0.8  # ... over this share of their outline: the head is bare, and all of its rim is used
BARE_LOSS = 1.25  # factor by which the rim of the face may fit worse for it
START_CLUTTER_MM = 12.0
BLOCK_PX = 20.0
BARE_SLACK_PX = 0.1  # noise of a contour's RMS
FLOOR_SIGMAS, MAX_FLOOR_PX = 3.0, 6.0
MIN_UNIT = 1.0  # px^3: noise of 0.5 px over 4 px. No upper limit: 40 let long hair before a face pull it 5 mm away


def update_noise(problem: ContourProblem, evidence: StageEvidence, state: State, stage: Stage) -> StageEvidence:
    """Updates the evidence from the residuals of a stage: the outlines' noise, the lower limit of the robust loss's
    scale and, the first time, the clutter (hair and clothes).

    Clutter (hair and clothes) is searched while the shape has only eigenheads. With more modes the shape would bulge
    into the hair, and the hair's outline would leave no large residuals.
    """
    rim = observed_rim(problem, evidence, state, stage)
    near = rim.residual[(np.abs(rim.residual) < 10.0) & (rim.length > 0)]
    deviation = 1.4826 * float(np.median(np.abs(near))) if len(near) > 10 else FIRST_NOISE_PX
    floor = min(FLOOR_SIGMAS * deviation, MAX_FLOOR_PX)
    clutter, settled = evidence.noise.clutter, evidence.noise.is_settled
    if not settled and not stage.whole_head:  # a bare head has none
        clutter, settled = find_clutter(problem, rim, max(CLUTTER_PX, CLUTTER_SIGMAS * deviation)), True
    unit = estimate_unit(problem, rim, 2.0 * floor) or evidence.noise.unit
    noise = replace(evidence.noise, unit=unit, floor_px=floor, clutter=clutter, is_settled=settled)
    return StageEvidence(noise, evidence.photographs)


def mark_start_clutter(problem: ContourProblem, evidence: StageEvidence, state: State, stage: Stage) -> StageEvidence:
    """Marks clutter before the first fit: wherever the silhouette reaches more than ``START_CLUTTER_MM`` beyond the
    mean head at the start pose.

    Long hair beside a face is wider than any face. A fit without these marks would follow hair before its residuals
    could show the hair.
    """
    rim = observed_rim(problem, evidence, state, stage)
    depths = [camera.camera_from_world.apply(state.world_from_head.translation)[2] for camera in problem.rig]
    px_per_mm = float(np.median([c.intrinsics.fx / z for c, z in zip(problem.rig, depths, strict=True)]))
    clutter = find_clutter(problem, rim, START_CLUTTER_MM * px_per_mm)
    return replace(evidence, noise=replace(evidence.noise, clutter=clutter))


def estimate_unit(problem: ContourProblem, rim: Rim, most_px: float) -> float | None:
    """Estimates the outlines' noise l sigma^2 (px^3) from their residuals, which include the model's misfit. Returns
    None if the settings give both the noise sigma and the correlation length l.

    The mean residual over a block of B px of outline has the variance l sigma^2 / B if B is well above the correlation
    length l. The correlation length l need not be known. Residuals of ``most_px`` and more are left out.
    """
    stated = problem.settings
    if stated.contour_noise_px is not None and stated.contour_correlation_px is not None:
        return None
    means = []
    for k in range(len(problem.views.names)):
        here = np.flatnonzero((rim.view == k) & (np.abs(rim.residual) < most_px) & (rim.length > 0))
        if not len(here):
            continue
        spoke = rim.pixel[here] - rim.pixel[here].mean(axis=0)
        order = here[np.argsort(np.arctan2(spoke[:, 1], spoke[:, 0]))]
        length = rim.length[order]
        block = (np.cumsum(length) / BLOCK_PX).astype(int)
        total = np.bincount(block, length)
        means.append((np.bincount(block, length * rim.residual[order]) / np.maximum(total, 1e-9))[total > BLOCK_PX / 2])
    found = np.concatenate(means) if means else np.zeros(0)
    variance = (1.4826 * float(np.median(np.abs(found)))) ** 2 if len(found) > 10 else FIRST_NOISE_PX**2
    return max(BLOCK_PX * variance, MIN_UNIT)


def is_hairless(problem: ContourProblem, evidence: StageEvidence, state: State, stage: Stage, from_face: State) -> bool:
    """Returns True if the outline of cranium and ears shows the head itself and not hair.

    ``state`` is the fit to the whole head, ``from_face`` the fit to the face alone. The head is bald if ``state``
    explains the whole outline and fits the face about as well as ``from_face``. A head model that fits hair fits the
    face worse.
    """
    rim = observed_rim(problem, evidence, state, replace(stage, whole_head=True))
    region = problem.model.levels[stage.level].face_region
    other = np.flatnonzero(~region[rim.corner].all(axis=1))
    face = np.flatnonzero(region[rim.corner].all(axis=1))
    agrees = np.abs(rim.residual) < BARE_PX
    if (rim.length * agrees)[other].sum() <= BARE_SHARE * rim.length[other].sum():
        return False
    alone = observed_rim(problem, evidence, from_face, replace(stage, whole_head=False))
    face_alone = np.flatnonzero(region[alone.corner].all(axis=1))
    return _robust_deviation_px(rim, face) < BARE_LOSS * _robust_deviation_px(alone, face_alone) + BARE_SLACK_PX


def _robust_deviation_px(rim: Rim, chosen: Int[np.ndarray, " s"]) -> float:
    """Returns the robust standard deviation (px) of the ``chosen`` residuals, from medians, which hair on the forehead
    hardly changes."""
    return 1.4826 * float(np.median(np.abs(rim.residual[chosen]))) if len(chosen) else 0.0
