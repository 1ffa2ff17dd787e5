"""Robust losses rho(s) of a squared residual s in units of its variance, and the weights rho'(s) of their equations.

Triggs, McLauchlan, Hartley and Fitzgibbon, *Bundle Adjustment: A Modern Synthesis*, 2000, section 3.3 (without the
second-order correction: J^T rho' J is never indefinite).
"""

from dataclasses import dataclass
from typing import Protocol, runtime_checkable

import numpy as np
from jaxtyping import Float


@runtime_checkable
class Loss(Protocol):
    """Describes a robust loss; both methods take squared residuals, without unit, and keep their shape."""

    def cost(self, squares: Float[np.ndarray, "*n"]) -> Float[np.ndarray, "*n"]:
        """Returns rho(s)."""
        ...

    def weight(self, squares: Float[np.ndarray, "*n"]) -> Float[np.ndarray, "*n"]:
        """Returns rho'(s): 1 at 0, less for residuals that the loss forgives."""
        ...


@dataclass(frozen=True, slots=True)
class LeastSquares:
    """Computes the loss rho(s) = s of Gaussian errors."""

    def cost(self, squares: Float[np.ndarray, "*n"]) -> Float[np.ndarray, "*n"]:
        return squares

    def weight(self, squares: Float[np.ndarray, "*n"]) -> Float[np.ndarray, "*n"]:
        return np.ones_like(squares)


@dataclass(frozen=True, slots=True)
class GemanMcClure:
    """Computes the loss rho(s) = s / (1 + s / c^2), at most c^2, so that residuals of many c have almost no weight.
    Geman and McClure 1987.

    ``scale``: c, in the unit of the unsquared residual; an array sets it for each residual.
    """

    scale: float | Float[np.ndarray, "*n"]

    def cost(self, squares: Float[np.ndarray, "*n"]) -> Float[np.ndarray, "*n"]:
        return squares / (1.0 + squares / self.scale**2)

    def weight(self, squares: Float[np.ndarray, "*n"]) -> Float[np.ndarray, "*n"]:
        return 1.0 / (1.0 + squares / self.scale**2) ** 2


@dataclass(frozen=True, slots=True)
class Cauchy:
    """Computes the loss rho(s) = c^2 log(1 + s / c^2), where ``scale`` is c."""

    scale: float

    def cost(self, squares: Float[np.ndarray, "*n"]) -> Float[np.ndarray, "*n"]:
        return self.scale**2 * np.log1p(squares / self.scale**2)

    def weight(self, squares: Float[np.ndarray, "*n"]) -> Float[np.ndarray, "*n"]:
        return 1.0 / (1.0 + squares / self.scale**2)


@dataclass(frozen=True, slots=True)
class Huber:
    """Computes the loss rho(s) = s up to c^2, 2 c sqrt(s) - c^2 beyond, where ``scale`` is c. Huber 1964."""

    scale: float

    def cost(self, squares: Float[np.ndarray, "*n"]) -> Float[np.ndarray, "*n"]:
        return np.where(squares < self.scale**2, squares, 2.0 * self.scale * np.sqrt(squares) - self.scale**2)

    def weight(self, squares: Float[np.ndarray, "*n"]) -> Float[np.ndarray, "*n"]:
        return np.minimum(1.0, self.scale / np.sqrt(np.maximum(squares, 1e-12)))
