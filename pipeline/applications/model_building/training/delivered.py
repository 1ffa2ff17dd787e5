"""Builds a head model from delivered heads, with their stated deviations.

The heads lie in their model's topology already, so nothing has to be corresponded. The model that made them is the
known population, and what it cannot make comes from them (``population_update``). Topology, landmarks and expressions
stay, so that the new model is used like the old one."""

from dataclasses import dataclass, replace

import numpy as np
from jaxtyping import Bool, Float

from pipeline.applications.model_building.training.population_update import Population, pooled, updated
from pipeline.applications.model_building.training.training import USED_MODES, above_neck, centred
from pipeline.head_model.model_file import ModelParts
from rig.geometry import rigid_fit
from rig.progress import Progress


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
