"""Solves linear equations whose matrix has the form of an arrow: some unknowns are shared by all blocks, the others
belong to one block each. No equation connects two blocks' unknowns, so each block is eliminated separately:

    S = M_ss - sum_k M_sk M_kk^-1 M_ks        (Schur complement of what is left)

The blocks' unknowns are computed after the shared unknowns are known. Unknowns with bounds are not eliminated."""

from collections.abc import Callable, Iterator
from dataclasses import dataclass
from functools import cached_property

import numpy as np
import scipy.linalg
from jaxtyping import Float, Int

from pipeline.estimation.bounded import least_within
from pipeline.estimation.levenberg_marquardt import cholesky_solve
from pipeline.estimation.positive_definite import inverse, inverse_diagonal

Matrix = Float[np.ndarray, "p p"]
Vector = Float[np.ndarray, " p"]
Rows = Int[np.ndarray, "_"]
Left = Float[np.ndarray, "r r"]  # of the unknowns that are left


@dataclass(frozen=True, slots=True, eq=False)
class Eliminated:
    """Holds an eliminated block: its row indices, the lower Cholesky factor of its matrix, and its columns for the r
    remaining unknowns."""

    rows: Rows
    root: Float[np.ndarray, "b b"]
    across: Float[np.ndarray, "b r"]

    def divide(self, right: Float[np.ndarray, "..."]) -> Float[np.ndarray, "..."]:
        """Returns the inverse of the block's matrix times ``right``, a vector of b or a matrix of b rows."""
        return scipy.linalg.cho_solve((self.root, True), right, check_finite=False)

    @property
    def taken(self) -> Left:
        """Returns the matrix that the block's elimination subtracts from the matrix of the remaining unknowns."""
        half = scipy.linalg.solve_triangular(self.root, self.across, lower=True, check_finite=False)
        return half.T @ half


@dataclass(frozen=True, eq=False)
class Arrow:
    """Holds which of ``size`` unknowns are eliminated: those in ``blocks``, each an ascending array of row indices."""

    size: int
    blocks: tuple[Rows, ...]

    @cached_property
    def left(self) -> Rows:
        """Returns the row indices of the unknowns that are not eliminated, ascending."""
        return np.setdiff1d(np.arange(self.size), np.concatenate([np.zeros(0, int), *self.blocks]))

    def solve(self, matrix: Matrix, right: Vector) -> Vector:
        """Solves the equations ``matrix x = right``. Raises LinAlgError if the matrix is not positive definite."""
        return self._whole(matrix, right, cholesky_solve)

    def least(self, matrix: Matrix, gradient: Vector, lower: Vector, upper: Vector) -> Vector:
        """Minimises a quadratic form within bounds, like ``least_within``. Eliminated unknowns must have no bound."""
        bounds = lower[self.left], upper[self.left]
        return self._whole(matrix, -gradient, lambda rest, right: least_within(rest, -right, *bounds))

    def variances(self, matrix: Matrix) -> Vector:
        """Returns the diagonal of the inverse of ``matrix`` for the remaining unknowns, and infinity for eliminated
        unknowns. Raises LinAlgError if the matrix is not positive definite."""
        found = np.full(self.size, np.inf)
        found[self.left] = inverse_diagonal(self._rest(matrix, self._eliminated(matrix)))
        return found

    def covariances(self, matrix: Matrix, blocks: tuple[Rows, ...]) -> Iterator[Float[np.ndarray, "_ _"]]:
        """Yields, for each of ``blocks``, the square block of the inverse of ``matrix`` at these rows and columns,
        exactly symmetric. Raises LinAlgError if the matrix is not positive definite."""
        gone = self._eliminated(matrix)
        known = inverse(self._rest(matrix, gone))
        for block in blocks:
            follows = (block[:, None] == self.left).astype(float)  # how each unknown follows those that are left
            alone = np.zeros((len(block), len(block)))
            for each in gone:
                inside = np.flatnonzero(np.isin(block, each.rows))
                if len(inside):
                    at = np.searchsorted(each.rows, block[inside])
                    follows[inside] = -each.divide(each.across)[at]
                    alone[np.ix_(inside, inside)] = each.divide(np.eye(len(each.rows)))[np.ix_(at, at)]
            found = follows @ known @ follows.T + alone
            yield 0.5 * (found + found.T)

    def _whole(self, matrix: Matrix, right: Vector, least: Callable[[Matrix, Vector], Vector]) -> Vector:
        gone, found = self._eliminated(matrix), np.empty(self.size)
        pulled = sum((each.across.T @ each.divide(right[each.rows]) for each in gone), np.zeros(len(self.left)))
        found[self.left] = least(self._rest(matrix, gone), right[self.left] - pulled)
        for each in gone:
            found[each.rows] = each.divide(right[each.rows] - each.across @ found[self.left])
        return found

    def _eliminated(self, matrix: Matrix) -> list[Eliminated]:
        return [
            Eliminated(
                rows,
                scipy.linalg.cholesky(matrix[np.ix_(rows, rows)], lower=True, check_finite=False),
                matrix[np.ix_(rows, self.left)],
            )
            for rows in self.blocks
        ]

    def _rest(self, matrix: Matrix, gone: list[Eliminated]) -> Left:
        rest = matrix[np.ix_(self.left, self.left)]
        for each in gone:
            rest -= each.taken
        return rest
