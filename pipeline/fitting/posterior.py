"""The Laplace posterior of a fit: what its covariance says of every vertex."""

import numpy as np
from jaxtyping import Float

from pipeline.eigenheads.model import HeadModel
from pipeline.fitting.fit import Fit
from rig.mesh import vertex_normals


def vertex_deviation_mm(model: HeadModel, fit: Fit) -> Float[np.ndarray, " v"]:
    """Standard deviation (mm) of every full-level vertex along its normal; zero where the fit has no covariance.

    Taken on the cage and carried to the full level by its operator, whose rows are convex combinations: a posterior is
    smooth there, and the cage has a twentieth of the vertices. Along the normal, since sliding along the surface
    neither moves the surface nor shows in a silhouette. Relief that no mode follows stands beside what the modes leave
    open.
    """
    operator = model.levels["full"].operator
    if fit.covariance is None:
        return np.zeros(model.levels["full"].count)
    rows = normal_rows(model, fit)
    # One triangular factor instead of rows @ covariance twice; the jitter keeps rounding from making it indefinite.
    covariance = 0.5 * (fit.covariance + fit.covariance.T)
    scale = np.sqrt(np.diag(covariance))
    factor = np.linalg.cholesky(covariance / np.outer(scale, scale) + 1e-9 * np.eye(len(scale))) * scale[:, None]
    variance = ((rows @ factor.astype(np.float32)) ** 2).sum(axis=1)
    if fit.misfit_mm is not None:
        variance = variance + fit.misfit_mm**2
    return np.sqrt(np.maximum(operator @ variance.astype(float), 0.0))


def normal_rows(model: HeadModel, fit: Fit) -> Float[np.ndarray, "v0 p"]:
    """d(position along the normal) / d(parameters of the covariance) at every cage vertex."""
    pose, count = fit.world_from_head, len(fit.coefficients)
    cage = model.cage(fit.coefficients)
    normals_head = vertex_normals(cage, model.levels["cage"].faces)
    by_shape = np.einsum(
        "vc,mvc->vm", (pose.scale * normals_head).astype(np.float32), model.modes[:count], optimize=True
    )
    arms = pose.apply(cage) - pose.translation
    normals = normals_head @ pose.rotation.T
    pose_rows = [np.cross(arms, normals), normals, (arms * normals).sum(axis=1, keepdims=True)]
    return np.concatenate([by_shape, *pose_rows], axis=1).astype(np.float32)
