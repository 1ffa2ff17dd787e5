"""Measures the quality of a model: compactness, generalisation and specificity.

R. Davies, *Learning Shape: Optimal Models for Analysing Natural Variability* (2002), chapter 5. No single one suffices:
a model of one head is compact and specific, a model that allows any shape generalises."""

from collections.abc import Iterable

import numpy as np
from jaxtyping import Bool, Float

from pipeline.head_model.pca import Components
from rig.progress import Progress


def compactness(sigma: Float[np.ndarray, " M"]) -> Float[np.ndarray, " M"]:
    """Returns for each m the share of the total variance that the first m modes have."""
    return np.cumsum(sigma.astype(float) ** 2) / np.sum(sigma.astype(float) ** 2)


def generalisation(
    components: Components, region: Bool[np.ndarray, " V"], counts: Iterable[int], *, report: Progress | None = None
) -> dict[int, float]:
    """Computes the mean vertex distance (mm, over ``region``) of each head to the nearest head in the PCA of all
    others, by number of modes.

    The heads are rotated into the components' own axes, which is exact for training heads. So each PCA is one of N - 1
    points in N - 1 dimensions instead of 3 V."""
    counts = list(counts)
    points = components.scores * components.sigma  # mm, orthonormal axes
    axes = (components.modes / components.sigma[:, None, None])[:, region].reshape(len(components.sigma), -1)
    errors = {count: 0.0 for count in counts}
    for k in range(len(points)):
        others = np.delete(points, k, 0)
        centre = others.mean(0)
        _, _, directions = np.linalg.svd(others - centre, full_matrices=False)
        offset = points[k] - centre
        for count in counts:
            used = directions[: min(count, len(points) - 2)]
            left = offset - used.T @ (used @ offset)
            errors[count] += np.linalg.norm((left @ axes).reshape(-1, 3), axis=1).mean() / len(points)
        if report:
            report("leaving one out", (k + 1) / len(points))
    return {count: float(value) for count, value in errors.items()}


def specificity(
    mean: Float[np.ndarray, "V 3"],
    modes: Float[np.ndarray, "M V 3"],
    heads: Float[np.ndarray, "N V 3"],
    region: Bool[np.ndarray, " V"],
    *,
    draws: int = 200,
    seed: int = 0,
) -> float:
    """Computes the mean distance (mm, in ``region``) of random draws of a model to the nearest of ``heads``."""
    rng = np.random.default_rng(seed)
    known = heads[:, region].astype(np.float32)
    total = 0.0
    for _ in range(draws):
        drawn = (mean + np.tensordot(rng.standard_normal(len(modes)), modes, 1))[region].astype(np.float32)
        total += np.linalg.norm(known - drawn, axis=2).mean(1).min() / draws
    return float(total)


def components_of(mean: np.ndarray, modes: np.ndarray, scores: np.ndarray) -> Components:
    """Returns a model's components in double precision."""
    sigma = np.linalg.norm(modes.reshape(len(modes), -1).astype(float), axis=1)
    return Components(mean.astype(float), modes.astype(float), sigma, scores.astype(float))
