"""Expressions read from a surface: planted weights of heads whose identity needs all eigenheads."""

from dataclasses import replace

import numpy as np
import pytest

from pipeline.contour_fit.fit import Fit
from pipeline.detail.expression_reading import read_expression
from pipeline.head_model.gaussian_process import with_kernel
from pipeline.head_model.model import HeadModel, with_expressions, with_modes
from rig.geometry import Similarity, rotation_from_vector

EIGENHEADS = 20  # of the fit; the heads have all
PLACE = Similarity(1.01, rotation_from_vector(np.array([0.02, -0.1, 0.01])), np.array([5.0, -3.0, 900.0]))
OFF = Similarity(1.0, rotation_from_vector(np.array([0.002, 0.001, -0.001])), np.array([0.3, -0.2, 0.4]))
FACE = {"mouthSmileLeft": 0.6, "mouthSmileRight": 0.3, "browDownLeft": 0.5, "cheekPuff": 0.4, "jawOpen": 0.1}


def read(model: HeadModel, weights: dict[str, float], *, known: int | None = None, covariance: bool = False) -> Fit:
    """Of a head that was seen with 0.05 mm of noise, by a fit that knows nothing but where the head is, roughly."""
    reduced = with_expressions(with_modes(model, EIGENHEADS))
    rng = np.random.default_rng(4)
    head = model.posed_vertices(rng.standard_normal(len(model.modes)), weights)
    seen = PLACE.apply(OFF.apply(head)) + 0.05 * rng.standard_normal(head.shape)
    unit = np.eye(len(reduced.modes) + 7) if covariance else None
    fit = Fit("contour", np.zeros(len(reduced.modes)), PLACE, 1, "planted", unit)
    observed, all_of_it = np.ones(len(head), bool), with_modes(model, known or len(model.modes))
    return read_expression(fit, reduced, all_of_it, seen, observed, eigenheads=EIGENHEADS)


def weights_of(model: HeadModel, fit: Fit) -> dict[str, float]:
    return dict(zip(model.expressions.names, fit.coefficients[EIGENHEADS:], strict=True))


def test_planted_weights_are_read_though_the_fit_lacks_most_eigenheads(model: HeadModel) -> None:
    found = weights_of(model, read(model, FACE))
    for name, weight in FACE.items():
        # The prior takes up to TAIL / (w + median) of a variance off: 0.1 of a weight that is known to 0.15.
        assert found[name] == pytest.approx(weight, abs=0.12), name
    assert sum(weight for name, weight in found.items() if name not in FACE) < 0.3
    assert max(weights_of(model, read(model, {})).values()) < 0.1


def test_what_a_head_has_of_other_eigenheads_is_no_expression(model: HeadModel) -> None:
    def off(known: int | None) -> float:
        found = weights_of(model, read(model, FACE, known=known))
        return sum(abs(weight - FACE.get(name, 0.0)) for name, weight in found.items())

    assert off(None) < 0.5 * off(EIGENHEADS)


def test_weights_carry_their_deviations_and_nothing_else_changes(model: HeadModel) -> None:
    fit = read(model, FACE, covariance=True)
    assert fit.covariance is not None
    deviation = np.sqrt(np.diag(fit.covariance))
    smile = EIGENHEADS + model.expressions.names.index("mouthSmileLeft")
    assert 0.005 < deviation[smile] < 0.2
    np.testing.assert_allclose(deviation[:EIGENHEADS], 1.0)
    np.testing.assert_array_equal(fit.coefficients[:EIGENHEADS], 0.0)


def test_a_model_without_expressions_is_left_alone(model: HeadModel) -> None:
    bare = with_modes(model, EIGENHEADS)
    fit = Fit("contour", np.zeros(EIGENHEADS), PLACE, 1, "planted")
    head = PLACE.apply(model.vertices(np.zeros(0)))
    reduced, seen = replace(bare, posed=range(0)), np.ones(len(head), bool)
    assert read_expression(fit, reduced, model, head, seen, eigenheads=EIGENHEADS) is fit


def test_a_head_of_another_population_keeps_what_the_fit_says(model: HeadModel) -> None:
    reduced = with_expressions(with_kernel(model, EIGENHEADS, most=60))
    rng, smooth = np.random.default_rng(6), slice(EIGENHEADS, reduced.posed.start)
    z = np.zeros(len(reduced.modes))
    fit = Fit("contour", z.copy(), PLACE, 1, "planted")
    for spread, left_alone in ((0.0, False), (1.5, True)):
        z[smooth] = spread * rng.standard_normal(reduced.posed.start - EIGENHEADS)
        z[reduced.posed.start + reduced.expressions.names.index("cheekPuff")] = 0.5
        head = PLACE.apply(reduced.vertices(z))
        seen = np.ones(len(head), bool)
        result = read_expression(fit, reduced, model, head, seen, eigenheads=EIGENHEADS)
        assert (result is fit) == left_alone
