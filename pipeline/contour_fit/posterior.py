"""Computes the uncertainty of a fitted head: its Laplace posterior and the standard deviation of every vertex.

Where no photograph constrains the surface, mostly under hair, the posterior equals the prior, so the prior's variance
must be right. Under hair a head of the model's population deviates by half of the kernel's standard deviation, a head
of another population by its double. ``estimate_prior`` therefore estimates the prior's variance from the
coefficients that the photographs determine (the evidence framework; MacKay 1992, *Bayesian interpolation*,
https://doi.org/10.1162/neco.1992.4.3.415).

Two errors that no shape coefficient describes are added to the standard deviation. The kernel moves the surface along
its normals only, but landmarks of real heads also shift along the surface. The shift along the surface gets the
standard deviation that the kernel has along the normal (``Fit.sliding_mm``). The second additional error of a vertex is
relief finer than the modes. A fit of eigenheads alone contains neither error (see ``add_span_misfit``).
"""

import math
from dataclasses import replace

import numpy as np
from jaxtyping import Float, Int

from pipeline.compute.trace import traced
from pipeline.contour_fit.fit import Fit
from pipeline.head_model.gaussian_process import SCALES
from pipeline.head_model.model import HeadModel
from pipeline.head_model.regions import head_regions
from rig.mesh import vertex_normals

# Measured on heads of the model's population and of another, with ears and forehead under hair (laboratory's hidden).
MIN_DETERMINED = 5.0  # coefficients; of fewer the prior's scale is not estimated
VARIANCE_RANGE = (0.1, 4.0)
KERNEL_VARIANCE_UNSEEN = 4.0  # hidden skin strays more than seen skin: no landmark holds it in its place
KERNEL_MM = math.hypot(*(scale.amplitude_mm for scale in SCALES))
RELIEF_OF_OUTLINES = 2.0  # times what photographs add to a head: outlines show no hollow, beside the nose or of an eye
EAR_MISFIT_MM = 5.0  # where the face says that an ear sits, by the variance ratio


@traced
def estimate_prior(model: HeadModel, fit: Fit, eigenheads: int, *, relief_mm: float) -> Fit:
    """Returns the fit with a covariance whose prior variance is estimated from the fit itself.

    If ``C`` is the covariance under unit priors, a group of modes gets the prior variance ``s^2 = sum z^2 / sum (1 -
    C_ii)``. The new covariance is ``(C^-1 + 1 / s^2 - 1)^-1`` (MacKay 1992). Coefficients that the photographs
    determine keep their variance.

    Args:
        model: the head model with all modes of the fit.
        fit: with its covariance under unit priors; a fit without a covariance, or without kernel modes, is returned
            unchanged.
        eigenheads: how many of the modes, the first ones, are eigenheads; the rest are the kernel's.
        relief_mm: standard deviation of relief finer than the modes, for a head that deviates as far as the kernel
            assumes.
    """
    if fit.covariance is None or len(fit.coefficients) <= eigenheads:
        return fit
    count = len(fit.coefficients)
    population = _variance_ratio(fit, np.arange(eigenheads))
    smooth = np.setdiff1d(np.arange(eigenheads, count), model.posed)
    kernel = _variance_ratio(fit, smooth)
    ratio = np.ones(len(fit.covariance))
    ratio[:eigenheads], ratio[smooth] = population, KERNEL_VARIANCE_UNSEEN * kernel
    information = np.linalg.inv(fit.covariance) + np.diag(1.0 / ratio - 1.0)
    relief = relief_mm * math.sqrt(kernel)
    misfit = np.maximum(0.0 if fit.misfit_mm is None else fit.misfit_mm, np.full(len(model.mean), relief))
    ears = head_regions(model)["ears"][: len(model.mean)]  # the cage's vertices come first
    misfit = np.where(ears, np.maximum(misfit, EAR_MISFIT_MM * min(kernel, 1.0 + 0.25 * kernel)), misfit)
    covariance = np.linalg.inv(0.5 * (information + information.T))
    return replace(fit, covariance=covariance, misfit_mm=misfit, sliding_mm=KERNEL_MM * math.sqrt(kernel))


def _variance_ratio(fit: Fit, modes: Int[np.ndarray, " k"]) -> float:
    """Estimates the prior variance of a group of modes relative to the unit prior; 1 if the photographs determine too
    few of them."""
    assert fit.covariance is not None
    determined = float(np.clip(1.0 - np.diag(fit.covariance)[modes], 0.0, 1.0).sum())
    if determined < MIN_DETERMINED:
        return 1.0
    return float(np.clip((fit.coefficients[modes] ** 2).sum() / determined, *VARIANCE_RANGE))


@traced
def vertex_deviation_mm(model: HeadModel, fit: Fit) -> Float[np.ndarray, " v"]:
    """Returns the standard deviation (mm) of every vertex of the full mesh along its normal; zero if the fit has no
    covariance.

    The deviation is computed at the vertices of the coarse mesh (the cage) and interpolated. Movement along the surface
    is left out, since it does not change the shape. Relief too fine for the modes (``Fit.misfit_mm``) is included.
    """
    operator = model.levels["full"].operator
    if fit.covariance is None:
        return np.zeros(model.levels["full"].count)
    return np.sqrt(np.maximum(operator @ cage_variance(model, fit), 0.0))


def cage_variance(model: HeadModel, fit: Fit) -> Float[np.ndarray, " v0"]:
    """Returns the variance (mm^2) along the normals at the vertices of the coarse mesh (the cage), including relief
    finer than the modes. The head's ``fit`` must have a covariance."""
    assert fit.covariance is not None
    rows = normal_rows(model, fit)
    # One triangular factor instead of rows @ covariance twice; the jitter keeps rounding from making it indefinite.
    covariance = 0.5 * (fit.covariance + fit.covariance.T)
    scale = np.sqrt(np.diag(covariance))
    factor = np.linalg.cholesky(covariance / np.outer(scale, scale) + 1e-9 * np.eye(len(scale))) * scale[:, None]
    variance = ((rows @ factor.astype(np.float32)) ** 2).sum(axis=1)
    misfit = 0.0 if fit.misfit_mm is None else fit.misfit_mm
    return variance.astype(float) + misfit**2


def normal_rows(model: HeadModel, fit: Fit) -> Float[np.ndarray, "v0 p"]:
    """Returns the Jacobian of the coarse mesh's (the cage's) vertices along their normals (mm), by coefficients,
    rotation, translation and log scale."""
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
