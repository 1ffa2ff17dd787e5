"""Defines robust losses rho(s) of a squared residual s in units of its variance, and their weights rho'(s).

The formulas follow Triggs, McLauchlan, Hartley and Fitzgibbon, *Bundle Adjustment: A Modern Synthesis*, 2000, section
3.3, without the second-order correction, so that J^T rho' J is never indefinite."""

from dataclasses import dataclass
from typing import Protocol, runtime_checkable

import numpy as np
from jaxtyping import Float


@runtime_checkable
class Loss(Protocol):
    """Describes a robust loss rho. The methods of a loss take squared residuals s, in squared standard deviations, and
    return one value for each of them."""

    def cost(self, squares: Float[np.ndarray, "*n"]) -> Float[np.ndarray, "*n"]:
        """Returns the loss rho(s) of each squared residual s."""
        ...

    def weight(self, squares: Float[np.ndarray, "*n"]) -> Float[np.ndarray, "*n"]:
        """Returns rho'(s), the weight of each residual: 1 at s = 0, and almost 0 for gross errors."""
        ...


@dataclass(frozen=True, slots=True)
class LeastSquares:
    """Computes the loss rho(s) = s, which suits Gaussian errors."""

    def cost(self, squares: Float[np.ndarray, "*n"]) -> Float[np.ndarray, "*n"]:
        """Returns the squared residuals unchanged."""
        return squares

    def weight(self, squares: Float[np.ndarray, "*n"]) -> Float[np.ndarray, "*n"]:
        """Returns 1 for every residual."""
        return np.ones_like(squares)


@dataclass(frozen=True, slots=True)
class GemanMcClure:
    """Computes Geman and McClure's loss (1987), rho(s) = s / (1 + s / c^2). The loss never exceeds c^2, so residuals of
    many c have almost no weight.

    ``scale`` is c, in the unit of the unsquared residual; an array gives each residual its own scale.
    """

    scale: float | Float[np.ndarray, "*n"]

    def cost(self, squares: Float[np.ndarray, "*n"]) -> Float[np.ndarray, "*n"]:
        """Returns s / (1 + s / c^2) for each squared residual s."""
        return squares / (1.0 + squares / self.scale**2)

    def weight(self, squares: Float[np.ndarray, "*n"]) -> Float[np.ndarray, "*n"]:
        """Returns 1 / (1 + s / c^2)^2 for each squared residual s."""
        return 1.0 / (1.0 + squares / self.scale**2) ** 2


@dataclass(frozen=True, slots=True)
class Cauchy:
    """Computes the loss rho(s) = c^2 log(1 + s / c^2), where ``scale`` is c, in the unit of the unsquared residual."""

    scale: float

    def cost(self, squares: Float[np.ndarray, "*n"]) -> Float[np.ndarray, "*n"]:
        """Returns c^2 log(1 + s / c^2) for each squared residual s."""
        return self.scale**2 * np.log1p(squares / self.scale**2)

    def weight(self, squares: Float[np.ndarray, "*n"]) -> Float[np.ndarray, "*n"]:
        """Returns 1 / (1 + s / c^2) for each squared residual s."""
        return 1.0 / (1.0 + squares / self.scale**2)


@dataclass(frozen=True, slots=True)
class Huber:
    """Computes Huber's loss (1964): rho(s) = s up to c^2, and 2 c sqrt(s) - c^2 beyond, where ``scale`` is c, in the
    unit of the unsquared residual."""

    scale: float

    def cost(self, squares: Float[np.ndarray, "*n"]) -> Float[np.ndarray, "*n"]:
        """Returns rho(s) for each squared residual s."""
        return np.where(squares < self.scale**2, squares, 2.0 * self.scale * np.sqrt(squares) - self.scale**2)

    def weight(self, squares: Float[np.ndarray, "*n"]) -> Float[np.ndarray, "*n"]:
        """Returns 1 for residuals of up to c, and c / sqrt(s) for larger ones."""
        return np.minimum(1.0, self.scale / np.sqrt(np.maximum(squares, 1e-12)))
