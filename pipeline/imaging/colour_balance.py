"""Estimates the gain and offset of every camera's colours, from head vertices that several cameras see.

A matt point reflects the same light in all directions, so ``g_k c_k + b_k`` should be equal for all cameras k that see
it. Each colour channel is solved by least squares in linear light; the unknown true colour of each point is eliminated.
Cauchy weights reduce the influence of shiny skin and of errors in the fitted surface. Two priors remove the remaining
ambiguity of the gains: the product of all gains is 1, and offsets are small."""

import numpy as np
from jaxtyping import Float, Float32

STEPS = 8  # of reweighting; gains move by less than 0.1 % after the fifth
GAIN_SPREAD = 0.3  # prior: cameras of a rig are set alike, to a third of a stop or so
OFFSET_SPREAD = 0.003  # of full scale: flare of a lens and the black level of a sensor
RELATIVE, ABSOLUTE = 0.06, 0.004  # disagreement that is ordinary: shine and misfit by level, noise
MIN_SHARED = 50  # vertices; with fewer in common a camera keeps the gain that the prior gives
SAMPLE = 4_000  # vertices are enough


def balance(
    weights: Float32[np.ndarray, "k v"], colours: Float32[np.ndarray, "k v 3"]
) -> tuple[Float[np.ndarray, "k 3"], Float[np.ndarray, "k 3"]]:
    """Computes a gain and an offset for each camera and channel, so that ``gains * colours + offsets`` agree between
    cameras. The product of all cameras' gains in each channel is 1."""
    cameras = len(weights)
    shared = np.flatnonzero(np.count_nonzero(weights, axis=0) >= 2)
    shared = shared[:: max(1, len(shared) // SAMPLE)]
    gains, offsets = np.ones((cameras, 3)), np.zeros((cameras, 3))
    if len(shared) < MIN_SHARED:
        return gains, offsets
    w = (weights[:, shared] > 0).astype(float)
    w *= np.sqrt(weights[:, shared] / weights[:, shared].max())
    w *= (colours[:, shared].max(axis=2) < 0.98) & (colours[:, shared].min(axis=2) > 0.002)  # not clipped ones
    for channel in range(3):
        values = colours[:, shared, channel].astype(float)
        gains[:, channel], offsets[:, channel] = _solve(values, w)
    return gains, offsets


def _solve(
    values: Float[np.ndarray, "k n"], weights: Float[np.ndarray, "k n"]
) -> tuple[Float[np.ndarray, " k"], Float[np.ndarray, " k"]]:
    cameras = len(values)
    gain, offset = np.ones(cameras), np.zeros(cameras)
    seen = weights.sum(axis=1) > 0
    for _ in range(STEPS):
        corrected = gain[:, None] * values + offset[:, None]
        total = np.maximum(weights.sum(axis=0), 1e-9)
        mean = (weights * corrected).sum(axis=0) / total
        scale = RELATIVE * mean + ABSOLUTE
        robust = weights / (1 + ((corrected - mean) / scale) ** 2) / scale**2
        gain, offset = _gauss_newton_step(values, robust, gain, offset)
        # The scale of all gains is free, and least squares would shrink it: hold their product at one.
        level = np.exp(np.log(gain[seen]).mean()) if seen.any() else 1.0
        gain, offset = gain / level, offset / level
    return gain, offset


def _gauss_newton_step(
    values: Float[np.ndarray, "k n"],
    weights: Float[np.ndarray, "k n"],
    gain: Float[np.ndarray, " k"],
    offset: Float[np.ndarray, " k"],
) -> tuple[Float[np.ndarray, " k"], Float[np.ndarray, " k"]]:
    """Returns the next gains and offsets, from normal equations in which the unknown true colour of every point is
    eliminated: ``P = W - w w^T / sum w``."""
    cameras, points = values.shape
    root = np.sqrt(np.maximum(weights.sum(axis=0), 1e-12))
    by_gain, by_offset = weights * values, weights
    parts = np.concatenate([by_gain, by_offset]) / root
    normal = -parts @ parts.T
    normal[:cameras, :cameras] += np.diag((by_gain * values).sum(axis=1))
    cross = np.diag(by_gain.sum(axis=1))
    normal[:cameras, cameras:] += cross
    normal[cameras:, :cameras] += cross
    normal[cameras:, cameras:] += np.diag(weights.sum(axis=1))
    # Errors along the surface are alike over some 50 vertices: so many fewer are worth counting against the prior.
    normal /= 50.0
    prior = np.concatenate([np.full(cameras, GAIN_SPREAD**-2), np.full(cameras, OFFSET_SPREAD**-2)])
    right = prior * np.concatenate([np.ones(cameras), np.zeros(cameras)])
    solution = np.linalg.solve(normal + np.diag(prior), right)
    assert points > 0
    return np.maximum(solution[:cameras], 0.05), solution[cameras:]
