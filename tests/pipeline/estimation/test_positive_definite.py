"""Inverses by the Cholesky factor, against the general ones."""

import numpy as np
import pytest

from pipeline.estimation.positive_definite import inverse, inverse_diagonal


def definite(seed: int, size: int = 40) -> np.ndarray:
    root = np.random.default_rng(seed).normal(size=(size, 2 * size))
    return root @ root.T


@pytest.mark.parametrize("seed", range(3))
def test_they_are_those_of_the_general_inverse(seed: int) -> None:
    matrix = definite(seed)
    expected, found = np.linalg.inv(matrix), inverse(matrix)
    np.testing.assert_allclose(found, expected, rtol=1e-9, atol=1e-12)
    np.testing.assert_array_equal(found, found.T)
    np.testing.assert_allclose(inverse_diagonal(matrix), np.diag(expected), rtol=1e-9)


def test_a_matrix_that_is_not_definite_is_refused() -> None:
    matrix = definite(0)
    matrix[3, 3] = -1.0
    for function in (inverse, inverse_diagonal):
        with pytest.raises(np.linalg.LinAlgError):
            function(matrix)
