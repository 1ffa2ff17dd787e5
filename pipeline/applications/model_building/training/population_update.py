"""Updates a population of heads by observed ones, each vertex as far as it is known.

Mean and covariance have the normal-inverse-Wishart prior that the known population gives (K. Murphy, *Conjugate
Bayesian analysis of the Gaussian distribution*, 2007, section 8): it counts as so many heads. Observed heads lie in it
only as far as their deviations let them: each is replaced by what it is expected to be in the population, and by the
covariance of that, a step of expectation maximisation for a Gaussian with known noise. Without it, what a rig could not
see would count as what people look like.
"""

from dataclasses import dataclass

import numpy as np
from jaxtyping import Float

from pipeline.head_model.pca import Components, orthogonalised
from rig.progress import Progress

MEAN_HEADS = 5.0  # as many observed heads as the known mean counts for
SPREAD_HEADS = 20.0  # and the known covariance
PATCHES = 33  # whose errors are independent: neighbours are off together
ROUNDS = 2


@dataclass(frozen=True, slots=True, eq=False)
class Population:
    """Holds a Gaussian of heads (mm): mean and orthogonal modes, one standard deviation each."""

    mean: Float[np.ndarray, "V 3"]
    modes: Float[np.ndarray, "M V 3"]


def updated(
    known: Population,
    heads: Float[np.ndarray, "N V 3"],
    deviation_mm: Float[np.ndarray, "N V"],
    *,
    report: Progress | None = None,
) -> Components:
    """Returns the population that is known after N heads were observed, which are aligned to its mean.

    ``deviation_mm`` is how far each of their vertices may be off along an axis, above zero. The scores are the heads'
    average, in the new modes."""
    expected, spread = heads, np.zeros((0, *known.mean.shape))
    now = pooled(known, expected, spread)
    for k in range(ROUNDS):
        expected, spread = _expected(now, heads, deviation_mm)
        now = pooled(known, expected, spread)
        if report:
            report("updating the population", (k + 1) / ROUNDS)
    flat = now.modes.reshape(len(now.modes), -1)
    sigma = np.linalg.norm(flat, axis=1)
    scores = (expected - now.mean).reshape(len(heads), -1) @ (flat / sigma[:, None] ** 2).T
    return Components(now.mean, now.modes, sigma, scores)


def pooled(
    known: Population, heads: Float[np.ndarray, "N V 3"], spread: Float[np.ndarray, "S V 3"] | None = None
) -> Population:
    """Returns the posterior mean of the population. The rows of ``spread`` are the square root of the covariance that
    the heads have besides, summed over all heads."""
    count, average = len(heads), heads.mean(axis=0)
    mean = (count * average + MEAN_HEADS * known.mean) / (count + MEAN_HEADS)
    between = np.sqrt(count * MEAN_HEADS / (count + MEAN_HEADS)) * (average - known.mean)
    scatter = [heads - average, np.sqrt(SPREAD_HEADS) * known.modes, between[None]]
    rows = np.concatenate(scatter if spread is None else [*scatter, spread]) / np.sqrt(count - 1 + SPREAD_HEADS)
    return Population(mean, orthogonalised(rows)[0])


def _expected(
    population: Population, heads: Float[np.ndarray, "N V 3"], deviation_mm: Float[np.ndarray, "N V"]
) -> tuple[Float[np.ndarray, "N V 3"], Float[np.ndarray, "M V 3"]]:
    """Returns each head as the population and its deviations let it be, and the square root of the covariances of all
    of them together."""
    count, vertices = population.modes.shape[:2]
    weight = np.sqrt(min(1.0, PATCHES / vertices)) / deviation_mm
    coefficients, covariance = np.zeros((len(heads), count)), np.zeros((count, count))
    for k, head in enumerate(heads):
        basis = (population.modes * weight[k][:, None]).reshape(count, -1)
        found = np.linalg.inv(np.eye(count) + basis @ basis.T)
        coefficients[k] = found @ (basis @ ((head - population.mean) * weight[k][:, None]).ravel())
        covariance += found
    flat = population.modes.reshape(count, -1)
    expected = (coefficients @ flat).reshape(heads.shape) + population.mean
    return expected, (np.linalg.cholesky(covariance).T @ flat).reshape(-1, vertices, 3)
