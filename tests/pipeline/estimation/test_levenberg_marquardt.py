"""The solver on problems whose minima are known, and against scipy's; what it says of how it ended."""

from dataclasses import dataclass

import numpy as np
import pytest
from scipy.optimize import least_squares

from pipeline.estimation.levenberg_marquardt import Limits, minimise
from pipeline.estimation.robust import Cauchy, GemanMcClure, Huber, LeastSquares, Loss
from pipeline.estimation.terms import Problem, Quadratic, Residuals

TIGHT = Limits(steps=200, tolerance=1e-20, tries=8)


@dataclass(frozen=True)
class Rosenbrock:
    """10 (y - x^2), 1 - x: a curved valley, minimum 0 at (1, 1)."""

    def at(self, value: np.ndarray) -> Residuals:
        x, y = value
        return Residuals(
            np.array([[10.0 * (y - x**2)], [1.0 - x]]), lambda: np.array([[[-20.0 * x, 10.0]], [[-1.0, 0.0]]])
        )


@dataclass(frozen=True)
class Line:
    """y = a + b t seen with noise and, in a fifth of the places, nonsense."""

    times: np.ndarray
    heights: np.ndarray
    loss: Loss

    def at(self, value: np.ndarray) -> Residuals:
        miss = value[0] + value[1] * self.times - self.heights
        rows = np.stack([np.ones_like(self.times), self.times], axis=1)[:, None]
        return Residuals(miss[:, None], lambda: rows, self.loss)


def line(loss: Loss) -> Line:
    rng = np.random.default_rng(0)
    times = np.linspace(0.0, 10.0, 50)
    heights = 2.0 + 0.5 * times + rng.normal(0, 0.1, 50)
    heights[::5] += 30.0
    return Line(times, heights, loss)


def test_the_valley_of_rosenbrock_is_followed_to_its_end_and_redescending_weights_leave_outliers_out() -> None:
    found = minimise(Problem((Rosenbrock(),), 2, np.add), np.array([-1.2, 1.0]), TIGHT)
    np.testing.assert_allclose(found.value, [1.0, 1.0], atol=1e-8)
    assert found.evidence.termination_reason == "converged"
    assert found.evidence.evaluations < 60
    found = minimise(Problem((line(GemanMcClure(1.0)),), 2, np.add), np.array([1.0, 1.0]), TIGHT)
    np.testing.assert_allclose(found.value, [2.0, 0.5], atol=0.1)  # three standard deviations of forty points


@pytest.mark.parametrize(("loss", "name"), [(LeastSquares(), "linear"), (Huber(2.0), "huber"), (Cauchy(1.0), "cauchy")])
def test_robust_minima_are_those_of_scipy(loss: Loss, name: str) -> None:
    term = line(loss)
    scale = getattr(loss, "scale", 1.0)
    oracle = least_squares(
        lambda value: term.at(value).residual[:, 0] / scale, np.zeros(2), loss=name, xtol=1e-15, ftol=1e-15, gtol=1e-15
    )
    found = minimise(Problem((term,), 2, np.add), np.zeros(2), TIGHT)
    np.testing.assert_allclose(found.value, oracle.x, atol=1e-6)
    assert found.evidence.cost == pytest.approx(2.0 * scale**2 * oracle.cost, rel=1e-9)


@pytest.mark.parametrize("loss", [LeastSquares(), GemanMcClure(1.7), Cauchy(1.7), Huber(1.7)], ids=str)
def test_weights_are_the_slopes_of_their_losses(loss: Loss) -> None:
    squares = np.array([1e-3, 0.5, 2.0, 4.0, 50.0])
    slope = (loss.cost(squares + 1e-6) - loss.cost(squares - 1e-6)) / 2e-6
    np.testing.assert_allclose(loss.weight(squares), slope, rtol=1e-6)


def test_a_prior_pulls_by_its_information() -> None:
    """Two Gaussians of one number: the mean weighted by information, which the normal matrix adds up."""
    terms = (Quadratic.prior(np.array([[4.0]]), np.array([1.0])), Quadratic.prior(np.array([[1.0]]), np.array([6.0])))
    problem = Problem(terms, 1, np.add)
    found = minimise(problem, np.array([50.0]), TIGHT)
    assert found.value[0] == pytest.approx(2.0)
    assert problem.equations(found.at).matrix[0, 0] == pytest.approx(5.0)


def test_what_is_held_and_what_nothing_determines_stays() -> None:
    free = np.array([False, True])
    found = minimise(Problem((Rosenbrock(),), 2, np.add, free), np.array([3.0, 0.0]), TIGHT)
    np.testing.assert_allclose(found.value, [3.0, 9.0])
    term = Quadratic.prior(np.diag([1.0, 0.0]), np.array([2.0, 7.0]))
    found = minimise(Problem((term,), 2, np.add), np.array([0.0, 3.0]), TIGHT)
    np.testing.assert_allclose(found.value, [2.0, 3.0], atol=1e-9)


def test_the_evidence_says_why_it_ended() -> None:
    problem, start = Problem((Rosenbrock(),), 2, np.add), np.array([-1.2, 1.0])
    short = minimise(problem, start, Limits(steps=2))
    assert short.evidence.termination_reason == "step limit"
    assert short.evidence.steps == 2
    assert short.evidence.cost == problem.at(short.value).cost < problem.at(start).cost
    stuck = minimise(Problem((Nonsense(),), 1, np.add), np.zeros(1), Limits())
    assert stuck.evidence.termination_reason == "no step lowers the cost"
    np.testing.assert_array_equal(stuck.value, [0.0])


class Nonsense:
    """Finite at zero alone, with a slope that leads away."""

    def at(self, value: np.ndarray) -> Residuals:
        miss = 1.0 if value[0] == 0 else np.nan
        return Residuals(np.array([[miss]]), lambda: np.ones((1, 1, 1)))
