"""Describes and removes the expression of a fitted head, and provides morph targets with Apple's names for
animation."""

from collections.abc import Collection, Mapping
from dataclasses import dataclass

import numpy as np
from jaxtyping import Float

from pipeline.contour_fit.fit import Fit
from pipeline.head_model.expressions import ARKIT, arkit_parts, closed_lids, words
from pipeline.head_model.model import HeadModel
from rig.geometry import Similarity
from rig.mesh import Mesh

TOLD = 0.05  # a smaller weight is nothing to speak of
MIN_SIGMA = 2.0  # nor one that its own deviation explains ...
READ_SIGMA = 1.0  # ... which takes less where the finished surface was asked: the prior has asked for more already
CLOSED = 0.8  # lids that are so far closed show no eye


@dataclass(frozen=True, slots=True)
class Found:
    """Holds one expression of a head: its name in the model, its weight from 0 to 1, and the weight's standard
    deviation (None if the fit has no covariance)."""

    name: str
    weight: float
    std: float | None

    @property
    def words(self) -> str:
        """Returns the expression's name in plain words."""
        return words(self.name)


@dataclass(frozen=True, slots=True, eq=False)
class BlendshapeRig:
    """Holds a neutral head, its morph targets, and their weights on the photographed head. ``missing`` are Apple's
    names without counterpart in the model; their morph targets are zero."""

    neutral_world: Mesh
    morphs: Mapping[str, Float[np.ndarray, "v 3"]]  # mm, head frame, at weight 1
    weights: Mapping[str, float]  # by morph: those of the head as photographed
    missing: tuple[str, ...]

    @property
    def moving(self) -> dict[str, Float[np.ndarray, "v 3"]]:
        """Returns the morph targets with a displacement other than zero."""
        return {name: morph for name, morph in self.morphs.items() if name not in self.missing}


def fitted_weights(model: HeadModel, fit: Fit) -> dict[str, float]:
    """Returns the fitted weight of every expression of the model, by name."""
    fitted = fit.coefficients[model.posed.start : model.posed.stop] if len(model.posed) else ()
    return dict(zip(model.expressions.names, (float(w) for w in fitted), strict=False))


def found_expressions(model: HeadModel, fit: Fit, least_sigma: float = MIN_SIGMA) -> tuple[Found, ...]:
    """Returns the head's expressions whose weight is at least ``TOLD`` and exceeds ``least_sigma`` standard deviations,
    the strongest first."""
    weights = fitted_weights(model, fit)
    spread = None if fit.covariance is None else np.sqrt(np.diag(fit.covariance))[np.asarray(model.posed, int)]
    found = []
    for k, (name, weight) in enumerate(weights.items()):
        std = None if spread is None else float(spread[k])
        if weight >= TOLD and weight > least_sigma * (std or 0.0):
            found.append(Found(name, weight, std))
    return tuple(sorted(found, key=lambda each: -each.weight))


def shut_eyes(model: HeadModel, fit: Fit) -> frozenset[str]:
    """Returns the eyes (``right``, ``left``) whose fitted lids are closed."""
    return frozenset(side for side, share in closed_lids(fitted_weights(model, fit)).items() if share >= CLOSED)


def neutral_mesh(model: HeadModel, place: Similarity, mesh_world: Mesh, found: Collection[Found]) -> Mesh:
    """Returns the head without the displacement of its expressions; all other detail is unchanged."""
    moved = model.levels["full"].operator @ model.expressions.moved({each.name: each.weight for each in found})
    back = place.scale * moved @ place.rotation.T
    return Mesh(mesh_world.vertices - back, mesh_world.faces, mesh_world.colours)


def build_blendshape_rig(
    model: HeadModel, place: Similarity, mesh_world: Mesh, found: Collection[Found]
) -> BlendshapeRig:
    """Builds the neutral head with Apple's 52 morph targets. Adds a target for every measured expression that these do
    not fully reproduce, so that the weights give the head as photographed."""
    operator, names = model.levels["full"].operator, model.expressions.names
    expression_weights = {each.name: each.weight for each in found}
    morphs, weights, left = {}, {}, dict(expression_weights)
    parts = arkit_parts(names)
    for name, rows in parts.items():
        shape = model.expressions.shapes[list(rows)].sum(axis=0) if rows else np.zeros_like(model.mean)
        morphs[name] = place.scale * (operator @ shape)
        weights[name] = float(np.mean([expression_weights.get(names[row], 0.0) for row in rows])) if rows else 0.0
        for row in rows:
            left[names[row]] = expression_weights.get(names[row], 0.0) - weights[name]
    for name, weight in left.items():
        if abs(weight) > 1e-6:
            morphs[name] = place.scale * (operator @ model.expressions.shapes[names.index(name)])
            weights[name] = weight
    missing = tuple(name for name in ARKIT if not parts[name])
    return BlendshapeRig(neutral_mesh(model, place, mesh_world, found), morphs, weights, missing)
