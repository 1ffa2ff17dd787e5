"""Downhill simplex: known minima, and scipy's Nelder-Mead beside it."""

import numpy as np
import pytest
from scipy.optimize import minimize, rosen

from pipeline.simplex.nelder_mead import minimise
from rig.errors import Cancelled


def sphere(x: np.ndarray) -> float:
    return float(((x - 3.0) ** 2).sum())


def ellipse(x: np.ndarray) -> float:
    return float((10.0 ** np.arange(len(x)) * (x - 1.0) ** 2).sum())


@pytest.mark.parametrize(
    ("function", "start", "minimum"),
    [
        (sphere, [0.0, 0.0, 0.0], [3.0, 3.0, 3.0]),
        (rosen, [-1.2, 1.0], [1.0, 1.0]),
        (ellipse, [0.0] * 4, [1.0] * 4),
        (lambda x: float((x[0] ** 2 + x[1] - 11) ** 2 + (x[0] + x[1] ** 2 - 7) ** 2), [1.0, 1.0], [3.0, 2.0]),
    ],
)
def test_known_minima(function, start: list[float], minimum: list[float]) -> None:
    found = minimise(function, np.array(start), np.ones(len(start)), tolerance=1e-12, limit=3000)
    assert found.cost < 1e-9
    np.testing.assert_allclose(found.value, minimum, atol=1e-4)
    assert function(found.value) == found.cost


def test_plateaus() -> None:
    steps = lambda x: float(np.floor(1000.0 * np.abs(x - 0.5)).sum())  # noqa: E731 - with plateaus, as counts of pixels
    found = minimise(steps, np.zeros(3), np.array([0.7, 0.8, 0.9]), tolerance=1e-6, limit=2000)
    assert np.abs(found.value - 0.5).max() < 0.02


@pytest.mark.parametrize(("function", "size"), [(rosen, 2), (rosen, 5), (ellipse, 6)])
def test_no_worse_than_scipy_with_the_same_simplex_and_budget(function, size: int) -> None:
    start, limit = np.full(size, -1.0), 400 * size
    ours = minimise(function, start, np.full(size, 0.7), tolerance=0.0, limit=limit)
    simplex = np.vstack([start, start + 0.7 * np.eye(size)])
    options = {"initial_simplex": simplex, "maxfev": limit, "maxiter": 10**6, "xatol": 0.0, "fatol": 0.0}
    theirs = minimize(function, start, method="Nelder-Mead", options=options)
    # The two differ in where they contract to; both end in the same valley.
    assert ours.cost <= max(1e-12, 10 * theirs.fun)


def test_it_ends_at_the_spread_or_at_the_limit_and_says_which() -> None:
    done = minimise(sphere, np.zeros(2), np.ones(2), tolerance=1e-2, limit=10_000)
    assert done.result == "converged"
    cut = minimise(rosen, np.zeros(4), np.ones(4), tolerance=0.0, limit=57)
    assert cut.result == "evaluation limit"
    assert 57 <= cut.evaluations < 57 + 2 + 4


def test_evaluations_are_counted_and_the_best_is_never_lost() -> None:
    calls: list[float] = []
    watched: list[tuple[int, float]] = []

    def counted(x: np.ndarray) -> float:
        calls.append(rosen(x))
        return calls[-1]

    found = minimise(
        counted, np.zeros(3), np.ones(3), tolerance=1e-8, limit=500, watch=lambda n, cost: watched.append((n, cost))
    )
    assert found.evaluations == len(calls) == watched[-1][0]
    assert found.cost == min(calls)
    costs = [cost for _, cost in watched]
    assert costs == sorted(costs, reverse=True)


def test_the_first_simplex_is_the_paper_s_and_the_watcher_may_stop_it() -> None:
    seen: list[np.ndarray] = []

    def record(x: np.ndarray) -> float:
        seen.append(x.copy())
        return sphere(x)

    def cancel(evaluations: int, cost: float) -> None:
        raise Cancelled

    minimise(record, np.array([1.0, 2.0]), np.array([3.0, 4.0]), limit=3)
    np.testing.assert_array_equal(seen[:3], [[1.0, 2.0], [4.0, 2.0], [1.0, 6.0]])
    with pytest.raises(Cancelled):
        minimise(sphere, np.zeros(2), np.ones(2), watch=cancel)
