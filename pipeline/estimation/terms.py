"""Defines the terms of a least-squares cost, each with its residuals, and the problem that consists of their sum.

A term at a given value has a cost and adds its contribution to the normal equations:

    matrix += J^T W J,    gradient += J^T W r,

The matrix W is the information times the robust weight; the gradient is half of the cost's gradient. ``Residuals`` is
the usual form of a term, with a Jacobian; a term whose Jacobian is too large to store adds its blocks directly."""

from collections.abc import Callable
from dataclasses import dataclass, field
from typing import Generic, Protocol, TypeVar, runtime_checkable

import numpy as np
from jaxtyping import Bool, Float

from pipeline.estimation.robust import LeastSquares, Loss


@dataclass(frozen=True, slots=True, eq=False)
class NormalEquations:
    """Holds the matrix J^T W J and the gradient J^T W r for p unknowns."""

    matrix: Float[np.ndarray, "p p"]
    gradient: Float[np.ndarray, " p"]

    @classmethod
    def empty(cls, size: int) -> "NormalEquations":
        """Returns normal equations for ``size`` unknowns that are all zeros, so without any term."""
        return cls(np.zeros((size, size)), np.zeros(size))


Value = TypeVar("Value")
ValueIn = TypeVar("ValueIn", contravariant=True)


@runtime_checkable
class Linearised(Protocol):
    """Describes a term linearised at one value of the unknowns: its cost and its contribution to normal equations."""

    @property
    def cost(self) -> float:
        """Returns the term's cost at this value, in squared standard deviations."""
        ...

    def add_to(self, equations: NormalEquations) -> None:
        """Adds the term's matrix and gradient to ``equations`` in place, because a matrix of a thousand unknowns takes
        8 MB."""
        ...


@runtime_checkable
class Term(Protocol[ValueIn]):
    """Describes one part of a cost, such as a prior or the fit to feature points, as a function of the value to
    estimate."""

    def at(self, value: ValueIn, /) -> Linearised:
        """Returns the term linearised at ``value``."""
        ...


@dataclass(frozen=True, slots=True, eq=False)
class Residuals:
    """Holds residuals at one value and a function that computes their Jacobian; the cost is ``sum_i rho(|r_i|^2)``.

    ``residual``: n residuals of d components, in standard deviations; ``jacobian`` computes their derivatives by the
    unknowns. The loss is of the norm of all d components.
    """

    residual: Float[np.ndarray, "n d"]
    jacobian: Callable[[], Float[np.ndarray, "n d p"]]
    loss: Loss = field(default_factory=LeastSquares)

    @property
    def squares(self) -> Float[np.ndarray, " n"]:
        """Returns the squared norm of each residual, in squared standard deviations."""
        return (self.residual**2).sum(axis=1)

    @property
    def cost(self) -> float:
        """Returns the sum of the robust losses of all residuals."""
        return float(self.loss.cost(self.squares).sum())

    def add_to(self, equations: NormalEquations) -> None:
        """Adds J^T W J and J^T W r in place, where W holds the robust weight of each residual."""
        root = np.repeat(np.sqrt(self.loss.weight(self.squares)), self.residual.shape[1])
        rows = self.jacobian().reshape(self.residual.size, -1) * root[:, None]
        equations.matrix[...] += rows.T @ rows  # A^T A: half the work of A^T B
        equations.gradient[...] += (root * self.residual.ravel()) @ rows


@dataclass(frozen=True, slots=True, eq=False)
class Linear:
    """Holds the residuals ``columns @ x - observed`` of a vector x, in standard deviations."""

    columns: Float[np.ndarray, "n p"]
    observed: Float[np.ndarray, " n"]
    loss: Loss = field(default_factory=LeastSquares)

    def at(self, value: Float[np.ndarray, " p"]) -> Residuals:
        """Returns the residuals of the vector ``value``."""
        residual = self.columns @ value - self.observed
        return Residuals(residual[:, None], lambda: self.columns[:, None], self.loss)


@dataclass(frozen=True, slots=True, eq=False)
class Quadratic:
    """Holds the quadratic form ``(x - c)^T M (x - c) - 2 g^T (x - c)`` of a vector x, with ``matrix`` M, ``centre`` c
    and ``pull`` g (towards the minimum). With g = 0 the term is a Gaussian prior. The form can also represent another
    problem after all of its unknowns except x have been eliminated."""

    matrix: Float[np.ndarray, "p p"]
    centre: Float[np.ndarray, " p"]
    pull: Float[np.ndarray, " p"]

    @classmethod
    def prior(cls, information: Float[np.ndarray, "p p"], mean: Float[np.ndarray, " p"]) -> "Quadratic":
        """Returns the quadratic form of the Gaussian prior N(mean, information^-1)."""
        return cls(information, mean, np.zeros(len(mean)))

    def at(self, value: Float[np.ndarray, " p"]) -> "LinearisedQuadratic":
        """Returns the quadratic form at the vector ``value``."""
        return LinearisedQuadratic(self, value - self.centre)


@dataclass(frozen=True, slots=True, eq=False)
class LinearisedQuadratic:
    """Holds the quadratic form ``term`` at a vector x, where ``away`` is x - c, the offset from the form's centre."""

    term: Quadratic
    away: Float[np.ndarray, " p"]

    @property
    def cost(self) -> float:
        """Returns the value of the quadratic form; it is negative where the linear part dominates."""
        return float(self.away @ self.term.matrix @ self.away - 2.0 * self.term.pull @ self.away)

    def add_to(self, equations: NormalEquations) -> None:
        """Adds the form's matrix M, and half of its gradient, M (x - c) - g, in place."""
        equations.matrix[...] += self.term.matrix
        equations.gradient[...] += self.term.matrix @ self.away - self.term.pull


@dataclass(frozen=True, slots=True, eq=False)
class Sum:
    """Combines several terms at one value into one term."""

    parts: tuple[Linearised, ...]

    @property
    def cost(self) -> float:
        """Returns the sum of the costs of all parts."""
        return sum(part.cost for part in self.parts)

    def add_to(self, equations: NormalEquations) -> None:
        """Adds the normal equations of every part in place."""
        for part in self.parts:
            part.add_to(equations)


@dataclass(frozen=True, slots=True, eq=False)
class FreeOnly:
    """Holds a term restricted to the unknowns that may change. ``free`` has one flag for each of all q unknowns;
    unknowns whose flag is False stay constant."""

    whole: Linearised
    free: Bool[np.ndarray, " q"]

    @property
    def cost(self) -> float:
        """Returns the cost of the whole term, which the restriction does not change."""
        return self.whole.cost

    def add_to(self, equations: NormalEquations) -> None:
        """Adds only the rows and columns of the free unknowns, in place. ``equations`` has the size of the free
        unknowns."""
        everything = NormalEquations.empty(len(self.free))
        self.whole.add_to(everything)
        equations.matrix[...] += everything.matrix[np.ix_(self.free, self.free)]
        equations.gradient[...] += everything.gradient[self.free]


@dataclass(frozen=True, slots=True, eq=False)
class Problem(Generic[Value]):
    """Holds a complete least-squares problem: its terms, the number of unknowns, and the function that applies a step
    to a value.

    ``free`` flags the unknowns that may move; None lets all of them move. ``moved(value, step)`` receives a step of all
    unknowns and returns the new value. ``room(value)`` returns the smallest and the largest step of each free unknown
    from there; infinite without a bound.
    """

    terms: tuple[Term[Value], ...]
    unknowns: int
    moved: Callable[[Value, Float[np.ndarray, " p"]], Value]
    free: Bool[np.ndarray, " p"] | None = None
    room: Callable[[Value], tuple[Float[np.ndarray, " f"], Float[np.ndarray, " f"]]] | None = None

    @property
    def size(self) -> int:
        """Returns the number of free unknowns."""
        return self.unknowns if self.free is None else int(np.count_nonzero(self.free))

    def at(self, value: Value) -> Linearised:
        """Returns the sum of all terms at ``value``, restricted to the free unknowns."""
        terms = Sum(tuple(term.at(value) for term in self.terms))
        return terms if self.free is None else FreeOnly(terms, self.free)

    def equations(self, here: Linearised) -> NormalEquations:
        """Returns the normal equations of the free unknowns for the linearised problem ``here``."""
        equations = NormalEquations.empty(self.size)
        here.add_to(equations)
        return equations

    def after(self, value: Value, step: Float[np.ndarray, " f"]) -> Value:
        """Returns ``value`` after a step of the free unknowns."""
        if self.free is None:
            return self.moved(value, step)
        whole = np.zeros(self.unknowns)
        whole[self.free] = step
        return self.moved(value, whole)
