"""Arrow-shaped equations against the same equations solved whole."""

import numpy as np
import pytest

from pipeline.applications.moments.arrow import Arrow
from pipeline.estimation.bounded import least_within

SHARED, OWN, BLOCKS = 7, 4, 3
SIZE = SHARED + OWN * BLOCKS


@pytest.fixture
def arrow() -> Arrow:
    """Of each block's four unknowns the last three are eliminated; the first is left, as a bounded one."""
    first = SHARED + OWN * np.arange(BLOCKS)
    return Arrow(SIZE, tuple(np.arange(row + 1, row + OWN) for row in first))


@pytest.fixture
def matrix() -> np.ndarray:
    rng, whole = np.random.default_rng(5), np.zeros((SIZE, SIZE))
    for k in range(BLOCKS):
        rows = np.r_[np.arange(SHARED), SHARED + OWN * k + np.arange(OWN)]
        jacobian = rng.standard_normal((30, len(rows)))
        whole[np.ix_(rows, rows)] += jacobian.T @ jacobian
    return whole


def test_the_solution_is_that_of_the_whole(arrow: Arrow, matrix: np.ndarray) -> None:
    right = np.random.default_rng(6).standard_normal(SIZE)
    assert np.allclose(arrow.solve(matrix, right), np.linalg.solve(matrix, right), rtol=1e-9, atol=1e-12)


def test_bounds_hold_for_what_is_left(arrow: Arrow, matrix: np.ndarray) -> None:
    gradient = 20.0 * np.random.default_rng(7).standard_normal(SIZE)
    lower, upper = np.full(SIZE, -np.inf), np.full(SIZE, np.inf)
    bounded = SHARED + OWN * np.arange(BLOCKS)
    lower[bounded], upper[bounded] = -0.02, 0.03
    found = arrow.least(matrix, gradient, lower, upper)
    assert np.allclose(found, least_within(matrix, gradient, lower, upper), rtol=1e-8, atol=1e-11)
    assert np.isclose(found[bounded], -0.02).any() or np.isclose(found[bounded], 0.03).any()


def test_covariances_are_blocks_of_the_inverse(arrow: Arrow, matrix: np.ndarray) -> None:
    whole = np.linalg.inv(matrix)
    blocks = tuple(np.r_[SHARED + OWN * k + np.array([2, 0, 3]), np.arange(SHARED)] for k in range(BLOCKS))
    for block, found in zip(blocks, arrow.covariances(matrix, blocks), strict=True):
        assert np.allclose(found, whole[np.ix_(block, block)], rtol=1e-8, atol=1e-12)
    variances = arrow.variances(matrix)
    assert np.allclose(variances[arrow.left], np.diag(whole)[arrow.left], rtol=1e-8)
    assert np.isinf(variances).sum() == BLOCKS * (OWN - 1)


def test_equations_that_are_not_definite_are_refused(arrow: Arrow, matrix: np.ndarray) -> None:
    matrix[-1, -1] = -1.0
    with pytest.raises(np.linalg.LinAlgError):
        arrow.solve(matrix, np.ones(SIZE))
