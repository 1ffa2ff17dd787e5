"""Quadratic forms with bounds: the conditions of Karush, Kuhn and Tucker, and the plain minimum where nothing binds."""

import numpy as np
import pytest

from pipeline.estimation.bounded import least_within
from pipeline.estimation.levenberg_marquardt import Limits, minimise
from pipeline.estimation.terms import Problem, Quadratic


def form(seed: int, size: int = 12) -> tuple[np.ndarray, np.ndarray]:
    rng = np.random.default_rng(seed)
    root = rng.normal(size=(size, 2 * size))
    return root @ root.T, 5.0 * rng.normal(size=size)


@pytest.mark.parametrize("seed", range(5))
def test_the_minimum_obeys_karush_kuhn_and_tucker(seed: int) -> None:
    matrix, gradient = form(seed)
    lower, upper = np.full(12, -np.inf), np.full(12, np.inf)
    lower[3:9], upper[3:9] = 0.0, 0.15
    found = least_within(matrix, gradient, lower, upper)
    slope, size = matrix @ found + gradient, np.abs(gradient).max()
    at_lower, at_upper = found <= lower, found >= upper
    assert at_lower.any()
    assert (found >= lower).all()
    assert (found <= upper).all()
    np.testing.assert_allclose(slope[~at_lower & ~at_upper] / size, 0.0, atol=1e-8)
    assert (slope[at_lower] > 0.0).all()
    assert (slope[at_upper] < 0.0).all()


def test_without_a_bound_in_the_way_it_is_the_plain_minimum() -> None:
    matrix, gradient = form(7)
    lower, upper = np.full(12, -np.inf), np.full(12, np.inf)
    lower[4], upper[4] = -100.0, 100.0
    np.testing.assert_allclose(least_within(matrix, gradient, lower, upper), np.linalg.solve(matrix, -gradient))


def test_levenberg_marquardt_stays_within_its_room() -> None:
    """The minimum of a tilted bowl whose own one lies at (2, -1), with the first unknown held below 1: the other then
    goes to -1 + 0.5 (1 - 2) by the bowl's own correlation, -M01 / M11 = -0.5."""
    bowl = Quadratic.prior(np.array([[2.0, 0.5], [0.5, 1.0]]), np.array([2.0, -1.0]))
    problem = Problem((bowl,), 2, np.add, room=lambda x: (np.array([-x[0], -np.inf]), np.array([1.0 - x[0], np.inf])))
    found = minimise(problem, np.array([0.2, 0.0]), Limits(tolerance=1e-14))
    np.testing.assert_allclose(found.value, [1.0, -0.5], atol=1e-6)
