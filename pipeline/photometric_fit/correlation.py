"""Computes the photo-consistency of patches: which views see each, which grey values they show along its normal, and
how well these correlate."""

import numpy as np
from jaxtyping import Bool, Float, Float32, Int

from pipeline.compute.threads import in_threads
from pipeline.photometric_fit.correlation_kernels import Members, Pictures, Samples, correlate_views, sweep_pictures
from pipeline.photometric_fit.patches import Patches

MIN_VIEW = 0.08  # squared cosine of a view that may still speak: 73 degrees


def choose_views(
    patches: Patches, weights: Float[np.ndarray, " e"], facing: Float32[np.ndarray, "k s"], least_seen: float, most: int
) -> tuple[Int[np.ndarray, "c n"], Float[np.ndarray, "c n"]]:
    """Chooses the views that compare each patch: at most ``most`` of those that see it most frontally and nearly whole
    (``least_seen``, a share). Returns them with their weights, the squared cosine between normal and line of sight; -1
    and 0 where there are fewer."""
    total = patches.sums(weights, np.ones((facing.shape[1], 1)))
    seen = patches.sums(weights, (facing > 0).T.astype(float))
    cosine = patches.sums(weights, facing.T.astype(float)) / np.maximum(seen, 1e-9)
    value = np.where(seen > least_seen * total, cosine**2, 0.0)
    view = np.argsort(-value, axis=1, kind="stable")[:, :most]
    value = np.take_along_axis(value, view, axis=1)
    speaks = value > MIN_VIEW
    return np.where(speaks, view, -1), np.where(speaks, value, 0.0)


def sweep(samples: Samples, pictures: Pictures, steps: Float[np.ndarray, " d"]) -> Float32[np.ndarray, "s k d"]:
    """Returns the grey value that each camera shows for every sample after it is moved along its normal by each of
    ``steps`` (mm)."""
    cameras, count = samples.seen.shape
    out = np.zeros((count, cameras, len(steps)), np.float32)
    in_threads(count, lambda a, b: sweep_pictures(a, b, samples, pictures, steps, out))
    return out


def correlate(
    patches: Patches,
    weights: Float[np.ndarray, " e"],
    view: Int[np.ndarray, "c n"],
    value: Float[np.ndarray, "c n"],
    seen: Bool[np.ndarray, "k s"],
    *,
    grey: Float32[np.ndarray, "s k d"],
    noise: Float[np.ndarray, " k"],
) -> Float32[np.ndarray, "c d"]:
    """Returns the mean normalised cross-correlation over the pairs of each patch's chosen views, for every step along
    the normal; 0 if there is no pair.

    Gain and offset of a view have no effect. ``noise``, the standard deviation of each camera's grey values, is part of
    the norm, so that patches without texture correlate with nothing. ``view`` and ``value`` are the results of
    ``choose_views``, ``grey`` that of ``sweep``.
    """
    score = np.zeros((len(patches.centre), grey.shape[2]), np.float32)
    members = Members(patches.start, patches.member, weights)
    in_threads(len(score), lambda a, b: correlate_views(a, b, members, view, value, seen, grey, noise, score))
    return score
