"""Aligns corresponded heads and computes their principal components (the paper's section 3.1 and the last step of 3.2).

Alignment is a rigid Procrustes analysis *without* scale: rigs measure in mm, and size is a mode of the population (the
paper's figure 2, first mode). The paper does not state the reference of the alignment; here the mean is re-estimated
until it converges (generalised Procrustes, Gower 1975), so that no single head is the reference."""

from dataclasses import dataclass

import numpy as np
from jaxtyping import Float

from rig.geometry import rigid_fit


@dataclass(frozen=True, slots=True, eq=False)
class Components:
    """Holds the principal components of a set of heads, which are mean + scores @ modes. Modes are orthogonal to each
    other, in mm per standard deviation."""

    mean: Float[np.ndarray, "V 3"]
    modes: Float[np.ndarray, "M V 3"]
    sigma: Float[np.ndarray, " M"]  # sqrt of the eigenvalue of the covariance (1 / (N - 1)), mm
    scores: Float[np.ndarray, "N M"]  # standard deviations


def align(
    heads: Float[np.ndarray, "N V 3"], weights: Float[np.ndarray, " V"], *, rounds: int = 10
) -> Float[np.ndarray, "N V 3"]:
    """Returns the heads, each moved rigidly (never scaled) onto their common mean. The mean has the pose and position
    of the first head; ``weights`` are vertex weights."""
    aligned, mean = heads.copy(), heads[0]
    first = heads[0]
    for _ in range(rounds):
        for k, head in enumerate(heads):
            aligned[k] = rigid_fit(head, mean, weights).apply(head)
        new = aligned.mean(0)
        new = rigid_fit(new, first, weights).apply(new)  # else the mean drifts with the first estimates
        settled = np.abs(new - mean).max() < 1e-6
        mean = new
        if settled:
            break
    return aligned


def principal_components(heads: Float[np.ndarray, "N V 3"]) -> Components:
    """Computes the at most N - 1 principal components of N aligned heads. The largest entry of each mode is made
    positive, so that repeated builds have the same signs."""
    count, vertices = heads.shape[:2]
    flat = heads.reshape(count, -1).astype(float)
    mean = flat.mean(0)
    # the N x N Gram matrix is far smaller than the 3V x 3V covariance and has the same non-zero spectrum
    centred = flat - mean
    values, vectors = np.linalg.eigh(centred @ centred.T / (count - 1))
    order = np.argsort(values)[::-1][: count - 1]
    values, vectors = np.maximum(values[order], 0), vectors[:, order]
    keep = values > values[0] * 1e-12
    sigma = np.sqrt(values[keep])
    units = centred.T @ vectors[:, keep] / (sigma * np.sqrt(count - 1))
    units *= np.sign(units[np.abs(units).argmax(0), np.arange(units.shape[1])])
    modes = (units * sigma).T.reshape(-1, vertices, 3)
    return Components(mean.reshape(-1, 3), modes, sigma, (centred @ units) / sigma)


def orthogonalised(modes: Float[np.ndarray, "M V 3"]) -> tuple[Float[np.ndarray, "K V 3"], Float[np.ndarray, " K"]]:
    """Returns linearly independent orthogonal modes that describe exactly the same Gaussian distribution of heads, and
    their standard deviations (mm).

    For z ~ N(0, I), heads are mean + A z with A = U S V^T. V^T z is N(0, I) again, so the modes U S describe the same
    distribution."""
    count, vertices = modes.shape[:2]
    flat = modes.reshape(count, -1).astype(float)
    values, vectors = np.linalg.eigh(flat @ flat.T)
    order = np.argsort(values)[::-1]
    keep = order[values[order] > values[order[0]] * 1e-12]
    turned = vectors[:, keep].T @ flat
    turned *= np.sign(turned[np.arange(len(turned)), np.abs(turned).argmax(1)])[:, None]
    return turned.reshape(-1, vertices, 3), np.sqrt(values[keep])
