"""A fit to the eigenheads says that it is off where the head is none of theirs, and how far."""

import numpy as np
import pytest

from pipeline.contour_fit.contour import add_span_misfit, finish, judged_by, solve_contour
from pipeline.contour_fit.fit import Fit
from pipeline.contour_fit.posterior import RELIEF_OF_OUTLINES, estimate_prior, vertex_deviation_mm
from pipeline.head_model.gaussian_process import model_basis, with_kernel
from pipeline.head_model.model import HeadModel, load_model, with_modes
from pipeline.settings import FittingSettings, Settings
from rig.geometry import Similarity
from rig.mesh import vertex_normals
from rig.studio.scene.layout import default_layout
from tests.support.subjects import Planted, binary_silhouettes, exact

RELIEF_MM = 0.5


@pytest.fixture(scope="module")
def span() -> HeadModel:
    return with_modes(load_model(), 60)


@pytest.fixture(scope="module")
def wider(span: HeadModel) -> HeadModel:
    return with_kernel(span, 60)


def test_what_two_fits_differ_by_is_misfit(span: HeadModel, wider: HeadModel) -> None:
    """A mode of the kernel, two deviations of it, that the narrower fit cannot have."""
    count = 61
    narrow = Fit("contour", np.zeros(60), Similarity.identity(), 1, "test", 1e-6 * np.eye(67))
    coefficients = np.concatenate([np.zeros(60), [2.0]])
    wide = Fit("contour", coefficients, Similarity.identity(), 1, "test", 1e-6 * np.eye(count + 7), sliding_mm=1.5)
    found = judged_by(with_modes(wider, count), wide, span, narrow)
    assert found.misfit_mm is not None
    normals = vertex_normals(span.mean.astype(float), span.levels["cage"].faces)
    expected = np.abs(2.0 * (wider.modes[60] * normals).sum(axis=1))
    np.testing.assert_allclose(found.misfit_mm, expected, atol=0.03)  # covariances of a thousandth of a deviation
    assert expected.max() > 1.0
    assert found.sliding_mm == 1.5


@pytest.mark.slow
@pytest.mark.gl
def test_a_head_beyond_the_span_is_said_to_be_farther_off(span, wider, renderer) -> None:
    """Two bare heads, one of them bent by the kernel: the deviation follows the true error of each."""
    rng, rig = np.random.default_rng(8), exact(default_layout())
    inside = np.concatenate([0.5 * rng.standard_normal(60), np.zeros(len(wider.modes) - 60)])
    beyond = inside + np.concatenate([np.zeros(60), 1.5 * rng.standard_normal(len(wider.modes) - 60)])
    face = span.levels["full"].face_region
    stated, plain, error = {}, {}, {}
    for name, coefficients in {"inside": inside, "beyond": beyond}.items():
        subject = Planted(name, coefficients, Similarity.identity(), Similarity.identity())
        seen = binary_silhouettes(wider, subject, rig, renderer)
        solved = solve_contour(span, Similarity.identity(), seen, rig, FittingSettings())
        fit = add_span_misfit(solved, wider, relief_mm=RELIEF_MM)
        head = fit.world_from_head.apply(span.vertices(fit.coefficients))
        off = np.linalg.norm(head - wider.vertices(coefficients), axis=1)
        error[name] = float(np.median(off[face]))
        stated[name] = float(np.median(vertex_deviation_mm(span, fit)[face]))
        plain[name] = float(np.median(vertex_deviation_mm(span, finish(solved))[face]))
    assert error["beyond"] > 4.0 * error["inside"]
    assert stated["beyond"] > 3.0 * stated["inside"]
    assert 0.3 * error["beyond"] < stated["beyond"] < 3.0 * error["beyond"]
    assert plain["beyond"] < 0.3 * error["beyond"]  # what the narrow fit's own covariance said


EIGENHEADS, STRAYS = 60, 1.3


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
        fit = estimate_prior(model, known_well(model), EIGENHEADS, relief_mm=relief_mm)
        stated = vertex_deviation_mm(model, fit)[ears_off]
        np.testing.assert_allclose(np.median(stated), STRAYS * relief_mm, rtol=0.05)


def test_a_fit_without_a_covariance_or_without_the_kernel_states_nothing_new(model: HeadModel) -> None:
    fit = known_well(model)
    assert estimate_prior(model, fit, len(fit.coefficients), relief_mm=RELIEF_MM) is fit
    silent = Fit("simplex", fit.coefficients, fit.world_from_head, 1, "converged")
    assert estimate_prior(model, silent, EIGENHEADS, relief_mm=RELIEF_MM) is silent
