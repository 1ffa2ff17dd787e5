"""Estimates a time offset of each camera from the dependence of its residuals on the board's motion.

The board's velocity in a shot is the central difference of its poses in the shots before and after. Time offsets are in
units of the time between shots, and are meaningful only if the shots are frames of one recording. The time offsets are
estimated jointly with all other parameters; the first camera's offset is zero."""

from dataclasses import dataclass, replace

import numpy as np
from jaxtyping import Float

from calibration.adjustment.bundle import HUBER, Free, adjust
from calibration.adjustment.lens_prior import LensPrior
from calibration.adjustment.state import BundleState, Observations, residuals, rms
from rig.geometry import RigidTransform, vector_from_rotation


@dataclass(frozen=True, slots=True, eq=False)
class TimeOffsets:
    """Holds each camera's time offset and its standard deviation (in intervals between shots). Also holds the
    residuals' RMS (px, 2D) without and with time offsets."""

    offsets: Float[np.ndarray, " c"]
    sigma: Float[np.ndarray, " c"]
    rms_without_px: float
    rms_with_px: float


def board_velocities(state: BundleState) -> Float[np.ndarray, "s 6"]:
    """Returns the board's motion per shot as a left perturbation of world_from_board (rad, mm). The board's motion in
    the first and last shot is a one-sided difference."""
    poses = [RigidTransform(r, t) for r, t in zip(state.board_rotations, state.board_translations, strict=True)]
    velocities = np.zeros((len(poses), 6))
    for i in range(len(poses)):
        first, last = max(0, i - 1), min(len(poses) - 1, i + 1)
        if last > first:
            motion = poses[last] @ poses[first].inverse()
            turn = vector_from_rotation(motion.rotation)
            # x' = x + w x x + v about the middle pose, so v is the motion of the point that the board turns about.
            middle = poses[i].translation
            shift = motion.apply(middle[None])[0] - middle
            velocities[i] = np.concatenate([turn, shift - np.cross(turn, middle)]) / (last - first)
    return velocities


def estimate_offsets(
    state: BundleState, observed: Observations, prior: LensPrior, sigma: Float[np.ndarray, " c"]
) -> TimeOffsets:
    """Estimates the time offsets by a second bundle adjustment, which starts from the solution ``state``."""
    before = rms(residuals(state, observed))
    state = replace(state, velocities=board_velocities(state))
    first = adjust(state, observed, prior, sigma, free=Free(offsets=True), loss=HUBER).state
    state = replace(first, velocities=board_velocities(first))  # which follow the poses, and those moved a little
    solution = adjust(state, observed, prior, sigma, free=Free(offsets=True), loss=HUBER)
    state = solution.state
    cameras = len(state.intrinsics)
    spread = np.sqrt(np.diag(solution.covariance())[-cameras:])
    return TimeOffsets(state.offsets, spread, before, rms(residuals(state, observed)))
