"""Builds a head model from delivered heads, with their stated deviations.

The heads lie in their model's topology already, so nothing has to be corresponded. The model that made them is the
known population, and what it cannot make comes from them. Topology, landmarks and expressions
stay, so that the new model is used like the old one.

The population is updated by the observed heads, each vertex as far as it is known. Mean and covariance have the normal-
inverse-Wishart prior that the known population gives (K. Murphy, *Conjugate Bayesian analysis of the Gaussian
distribution*, 2007, section 8): it counts as so many heads. Observed heads lie in it only as far as their deviations
let them: each is replaced by what it is expected to be in the population, and by the covariance of that, a step of
expectation maximisation for a Gaussian with known noise. Without it, what a rig could not see would count as what
people look like.
"""

from dataclasses import dataclass, replace

import numpy as np
from jaxtyping import Bool, Float

from pipeline.applications.model_building.training.training import USED_MODES, above_neck, centred
from pipeline.head_model.model_file import ModelParts
from pipeline.head_model.pca import Components, orthogonalised
from rig.geometry import rigid_fit
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


@dataclass(frozen=True, slots=True, eq=False)
class Delivered:
    """Holds N heads without expression in the head frame of their model, mm, at true size."""

    names: tuple[str, ...]
    cages: Float[np.ndarray, "N V0 3"]
    deviation_mm: Float[np.ndarray, "N V0"]  # along the normal, above zero


def updated_model(parts: ModelParts, delivered: Delivered, *, name: str, report: Progress | None = None) -> ModelParts:
    """Returns the model that ``parts`` becomes by heads that it made. Its figures have the mean distance of a face from
    the modes before and after (mm), each head held out once."""
    known = Population(parts.mean.astype(float), parts.modes.astype(float))
    weights = above_neck(known.mean, parts.landmarks)
    heads = np.array([rigid_fit(head, known.mean, weights).apply(head) for head in delivered.cages])
    components = updated(known, heads, delivered.deviation_mm, report=report)
    before, after = held_out_mm(known, heads, parts.face_region)
    modes_used = min(USED_MODES, len(components.modes))
    return replace(
        parts,
        name=name,
        licence=f"{parts.licence}; the rights in the delivered heads apply",
        source=f"{parts.name}, updated by {len(heads)} delivered heads",
        notice=f"{parts.notice} Updated by eigenhead from delivered heads.".strip(),
        subjects={"total": len(heads), "male": 0, "female": 0},  # results do not say
        mean=centred(components.mean[None], parts.landmarks)[0],
        modes=components.modes,
        sigma=components.sigma,
        scores=components.scores,
        figures={"held_out_mm": after, "held_out_before_mm": before, "modes_used": modes_used},
    )


def held_out_mm(
    known: Population, heads: Float[np.ndarray, "N V 3"], face: Bool[np.ndarray, " V"]
) -> tuple[float, float]:
    """Computes the mean distance (mm, over the face) of each head to the nearest of the first 60 modes of the known
    population, and of that updated by all other heads."""
    far = [
        [_nearest_mm(population, heads[k], face) for population in (known, pooled(known, np.delete(heads, k, axis=0)))]
        for k in range(len(heads))
    ]
    before, after = np.mean(far, axis=0)
    return float(before), float(after)


def _nearest_mm(population: Population, head: Float[np.ndarray, "V 3"], face: Bool[np.ndarray, " V"]) -> float:
    basis = population.modes[:USED_MODES].reshape(min(USED_MODES, len(population.modes)), -1)
    basis = basis / np.linalg.norm(basis, axis=1, keepdims=True)
    offset = (head - population.mean).ravel()
    left = (offset - (basis @ offset) @ basis).reshape(-1, 3)
    return float(np.linalg.norm(left[face], axis=1).mean())


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
