"""What a fit states where photographs are silent."""

import numpy as np
import pytest

from pipeline.contour_fit.fit import Fit
from pipeline.contour_fit.posterior import RELIEF_OF_OUTLINES, vertex_deviation_mm, with_estimated_prior
from pipeline.head_model.gaussian_process import model_basis
from pipeline.head_model.model import HeadModel, load_model
from pipeline.settings import Settings
from rig.geometry import Similarity

EIGENHEADS, RELIEF_MM, STRAYS = 60, 0.5, 1.3


@pytest.fixture(scope="module")
def model() -> HeadModel:
    return model_basis(load_model(), Settings(detail="kernel"))


def known_well(model: HeadModel) -> Fit:
    """Every coefficient to a thousandth, of a head that strays from the eigenheads by 1.3 times the kernel's prior."""
    count = len(model.modes)
    coefficients = np.zeros(count)
    coefficients[EIGENHEADS:] = STRAYS * np.tile([1.0, -1.0], count)[: count - EIGENHEADS]
    covariance = 1e-6 * np.eye(count + 7)
    return Fit("contour", coefficients, Similarity.identity(), 1, "converged", covariance)


def test_relief_that_no_mode_follows_grows_with_how_far_the_head_strays(model: HeadModel) -> None:
    ears_off = model.levels["full"].face_region
    for relief_mm in (RELIEF_MM, RELIEF_OF_OUTLINES * RELIEF_MM):
        fit = with_estimated_prior(model, known_well(model), EIGENHEADS, relief_mm=relief_mm)
        stated = vertex_deviation_mm(model, fit)[ears_off]
        np.testing.assert_allclose(np.median(stated), STRAYS * relief_mm, rtol=0.05)


def test_a_fit_without_a_covariance_or_without_the_kernel_states_nothing_new(model: HeadModel) -> None:
    fit = known_well(model)
    assert with_estimated_prior(model, fit, len(fit.coefficients), relief_mm=RELIEF_MM) is fit
    silent = Fit("simplex", fit.coefficients, fit.world_from_head, 1, "converged")
    assert with_estimated_prior(model, silent, EIGENHEADS, relief_mm=RELIEF_MM) is silent
