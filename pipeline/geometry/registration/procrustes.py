"""Full ordinary Procrustes analysis (section 4.2, eq. 3) and its form with a covariance."""

import numpy as np
from jaxtyping import Float

from rig.geometry import RigidTransform, Similarity, cross_matrix, nearest_rotation, rotation_from_vector

SCALE_SPREAD = 0.02  # prior on log scale: rigs are metric, and what is left is calibration's error of scale
ITERATIONS = 20


def procrustes(
    source: Float[np.ndarray, "n 3"], target: Float[np.ndarray, "n 3"], weights: Float[np.ndarray, " n"] | None = None
) -> Similarity:
    """Computes the full ordinary Procrustes alignment: the similarity T that minimises eq. (3), ``sum_j w_j |target_j -
    T(source_j)|^2``.

    Dryden and Mardia, Statistical Shape Analysis, section 7.2; the determinant excludes mirror images. Raises
    ValueError if the points lie on a line and determine no rotation.
    """
    share = np.full(len(source), 1.0 / len(source)) if weights is None else weights / weights.sum()
    source_mean, target_mean = share @ source, share @ target
    centred, wanted = source - source_mean, target - target_mean
    covariance = (wanted * share[:, None]).T @ centred
    singular = np.linalg.svd(covariance, compute_uv=False)
    if singular[1] <= 1e-12 * singular[0]:
        raise ValueError("points on a line determine no rotation")
    rotation = nearest_rotation(covariance)
    scale = float((rotation * covariance).sum() / (share @ (centred**2).sum(axis=1)))
    return Similarity(scale, rotation, target_mean - scale * rotation @ source_mean)


def rigid_procrustes(source: Float[np.ndarray, "n 3"], target: Float[np.ndarray, "n 3"]) -> RigidTransform:
    """Computes the rigid motion that minimises eq. (3), as ``procrustes``: of the same turn, but without a scale, which
    fits few points too well."""
    rotation = procrustes(source, target).rotation
    return RigidTransform(rotation, target.mean(axis=0) - rotation @ source.mean(axis=0))


def generalised_procrustes(
    source: Float[np.ndarray, "n 3"],
    target: Float[np.ndarray, "n 3"],
    source_covariance: Float[np.ndarray, "p p"],
    target_covariance: Float[np.ndarray, "p p"],
    *,
    start: Similarity,
    scale_spread: float = SCALE_SPREAD,
) -> Similarity:
    """Computes the most likely similarity T for ``target = T(source + e) + f``, where the errors e (head frame) and f
    (world frame) are correlated between points.

    Iterated generalised least squares from ``start``: the residual's covariance is ``s^2 R C R^T + F``, taken at the
    last estimate. log s has the prior N(0, ``scale_spread``^2).
    """
    scale, rotation, translation = start.scale, start.rotation, start.translation
    for _ in range(ITERATIONS):
        turn = scale * np.kron(np.eye(len(source)), rotation)
        whiten = np.linalg.inv(np.linalg.cholesky(turn @ source_covariance @ turn.T + target_covariance))
        turned = scale * source @ rotation.T
        residual = (target - turned - translation).ravel()
        # columns: left turn about the head's origin, shift, log scale
        shift = np.tile(np.eye(3), (len(turned), 1, 1))
        jacobian = np.concatenate([-cross_matrix(turned), shift, turned[:, :, None]], axis=2).reshape(-1, 7)
        rows = np.concatenate([whiten @ jacobian, np.eye(7)[6:] / scale_spread])
        step = np.linalg.lstsq(rows, np.append(whiten @ residual, -np.log(scale) / scale_spread), rcond=None)[0]
        rotation = rotation_from_vector(step[:3]) @ rotation
        translation = translation + step[3:6]
        scale *= float(np.exp(step[6]))
        if np.linalg.norm(step[:3]) < 1e-10 and np.linalg.norm(step[3:6]) < 1e-8:
            break
    return Similarity(scale, rotation, translation)


def block_diagonal(blocks: Float[np.ndarray, "n 3 3"]) -> Float[np.ndarray, "p p"]:
    """Returns the joint covariance of points whose errors are independent, from the covariance of each."""
    whole = np.zeros((len(blocks), 3, len(blocks), 3))
    whole[np.arange(len(blocks)), :, np.arange(len(blocks)), :] = blocks
    return whole.reshape(3 * len(blocks), -1)
