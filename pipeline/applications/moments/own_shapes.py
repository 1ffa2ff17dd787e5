"""Estimates a person's neutral head and personal blendshapes from heads of the same person with different expressions.

At each vertex, y_k is the difference between the head of capture k and the head model's prediction:

    y_k = u + sum_e w_ke d_e + noise,    u ~ N(0, r^2),    d_e ~ N(0, (OWN |S_e|)^2)

Here the relief u is common to all captures, d_e is the difference between the person's blendshape e and the head
model's S_e, and w_ke are the expression weights. Each head's noise has the standard deviation that the head's fit
states. Cameras, hair and light make a fraction ``COMMON`` of the noise variance the same in all captures; averaging
over captures does not reduce this fraction. Each vertex is computed separately; the results are smooth because the
heads are smooth. All distributions are Gaussian, so the K x K covariance of the y_k at each vertex suffices."""

from dataclasses import dataclass

import numpy as np
from jaxtyping import Float, Float32

from pipeline.head_model.expressions import ARKIT, arkit_parts
from pipeline.head_model.model import HeadModel

RELIEF_MM = 1.0  # r: deviation of what the heads have beyond the model's modes
OWN = 0.3  # deviation of a person's shape from the model's, as a share of its displacement
SHOWN = 0.1  # least weight of a shape, in some capture, that occurs in the take
COMMON = 0.5  # share of the variance that a take's heads have in common


@dataclass(frozen=True, slots=True, eq=False)
class OwnShapes:
    """Holds a person's neutral head (head frame, mm) and the person's 52 blendshapes under Apple's names. ``shown``
    lists the blendshapes that occur in the take; all others are copied from the head model."""

    neutral: Float[np.ndarray, "v 3"]
    deviation_mm: Float[np.ndarray, " v"]
    shapes: Float32[np.ndarray, "n v 3"]  # mm at weight 1, in the order of ``ARKIT``
    shape_deviation_mm: Float32[np.ndarray, "n v"]  # of each shape, in any direction
    shown: tuple[str, ...]


def estimate_own_shapes(
    model: HeadModel,
    neutral: Float[np.ndarray, "v 3"],
    scale: float,
    weights: Float[np.ndarray, "k e"],
    heads: Float[np.ndarray, "k v 3"],
    deviation_mm: Float[np.ndarray, "k v"],
) -> OwnShapes:
    """Estimates the neutral head and blendshapes that best explain several heads of one person.

    Args:
        model: the head model, with its expressions.
        neutral: the head model's neutral head for all captures, finest mesh, head frame, mm.
        scale: the subject's scale, by which the model's blendshapes are multiplied.
        weights: the weights of the model's expressions in each capture, 0 to 1.
        heads: each capture's head, finest mesh, head frame, mm.
        deviation_mm: the standard deviation of each capture's vertices along their normals.
    """
    operator, names = model.levels["full"].operator, model.expressions.names
    full = np.zeros((len(names), *neutral.shape), np.float32)
    for row, shape in enumerate(model.expressions.shapes):
        full[row] = scale * (operator @ shape)
    off = heads - neutral - np.einsum("ke,evc->kvc", weights.astype(np.float32), full, optimize=True)
    prior = (OWN * np.linalg.norm(full, axis=2).T) ** 2  # (v, e)
    expected = RELIEF_MM**2 + np.einsum("ke,ve,je->vkj", weights, prior, weights, optimize=True)
    sigma = deviation_mm.T
    expected += COMMON * sigma[:, :, None] * sigma[:, None, :]
    diagonal = np.arange(len(heads))
    expected[:, diagonal, diagonal] += (1.0 - COMMON) * sigma**2
    known = np.linalg.inv(expected)  # (v, k, k)
    pulled = np.einsum("vkj,jvc->vkc", known, off, optimize=True)
    relief = RELIEF_MM**2 * pulled.sum(axis=1)
    left = RELIEF_MM**2 - RELIEF_MM**4 * known.sum(axis=(1, 2))
    moved = np.einsum("ve,ke,vkc->evc", prior, weights, pulled, optimize=True)
    explained = np.einsum("ke,vkj,je->ve", weights, known, weights, optimize=True)
    variance = np.maximum(prior - prior**2 * explained, 0.0).T
    # The model's own error of the neutral head is the same in all heads.
    common = COMMON * sigma.min(axis=1) ** 2
    rows = arkit_parts(names)
    shapes = np.stack([(full + moved)[list(rows[name])].sum(axis=0) for name in ARKIT])
    spread = np.stack([np.sqrt(variance[list(rows[name])].sum(axis=0)) for name in ARKIT])
    shown = tuple(name for name in ARKIT if rows[name] and weights[:, list(rows[name])].max() >= SHOWN)
    return OwnShapes(
        neutral + relief,
        np.sqrt(np.maximum(left, 0.0) + common),
        shapes.astype(np.float32),
        spread.astype(np.float32),
        shown,
    )
