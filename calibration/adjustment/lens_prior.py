"""Defines Gaussian priors of the intrinsics, from knowledge about lenses that does not come from the corners.

The default lens priors are weak: they only influence parameters that the views hardly determine."""

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from jaxtyping import Float

from calibration.adjustment.state import INTRINSICS, PER_CAMERA, BundleState
from pipeline.estimation.terms import NormalEquations

# Standard deviations of the priors. Lenses of 15 to 85 mm full-frame equivalent span a factor 2 to either side of 1.2
# image widths; sensors have square pixels to a percent; optical axes pass near the middle.
FOCAL_PRIOR, ASPECT_PRIOR, CENTRE_PRIOR = 0.7, 0.01, 0.05
LENS_PRIOR = {"k1": 0.5, "k2": 0.5, "p1": 0.01, "p2": 0.01, "k3": 0.5}


@dataclass(frozen=True, slots=True, eq=False)
class LensPrior:
    """Holds the mean and the information (inverse covariance) of each camera's intrinsics."""

    mean: Float[np.ndarray, "c 9"]
    information: Float[np.ndarray, "c 9 9"]

    def combine(self, mean: Float[np.ndarray, "c 9"], information: Float[np.ndarray, "c 9 9"]) -> "LensPrior":
        """Returns the product of this prior with a second, independent Gaussian prior."""
        total = self.information + information
        pull = np.einsum("cij,cj->ci", self.information, self.mean) + np.einsum("cij,cj->ci", information, mean)
        return LensPrior(np.linalg.solve(total, pull[:, :, None])[:, :, 0], total)

    def at(self, state: BundleState) -> "LinearisedLensPrior":
        """Evaluates the prior at a state of the bundle adjustment."""
        return LinearisedLensPrior(self, state.intrinsics - self.mean)


@dataclass(frozen=True, slots=True, eq=False)
class LinearisedLensPrior:
    """Holds the prior and the difference ``away`` of the state's intrinsics from the prior's mean."""

    prior: LensPrior
    away: Float[np.ndarray, "c 9"]

    @property
    def cost(self) -> float:
        """Returns the squared Mahalanobis distance from the mean, summed over the cameras."""
        return float(np.einsum("ci,cij,cj->", self.away, self.prior.information, self.away))

    def add_to(self, equations: NormalEquations) -> None:
        """Adds the prior to the normal equations."""
        for camera, (information, away) in enumerate(zip(self.prior.information, self.away, strict=True)):
            block = slice(camera * PER_CAMERA, camera * PER_CAMERA + len(INTRINSICS))
            equations.matrix[block, block] += information
            equations.gradient[block] += information @ away


class AspectTerm:
    """Computes the residual ``2 (fx - fy) / (fx + fy) / ASPECT_PRIOR``, a prior that pixels are nearly square."""

    def at(self, state: BundleState) -> "LinearisedAspectPrior":
        """Returns the term at a state."""
        return LinearisedAspectPrior(*state.intrinsics[:, :2].T)


@dataclass(frozen=True, slots=True, eq=False)
class LinearisedAspectPrior:
    """Holds the focal lengths (px) of all cameras at one state."""

    fx: Float[np.ndarray, " c"]
    fy: Float[np.ndarray, " c"]

    @property
    def residual(self) -> Float[np.ndarray, " c"]:
        """Returns the residual of each camera, in standard deviations."""
        return 2.0 * (self.fx - self.fy) / (self.fx + self.fy) / ASPECT_PRIOR

    @property
    def cost(self) -> float:
        """Returns the sum of squared residuals."""
        return float((self.residual**2).sum())

    def slopes(self) -> Float[np.ndarray, "c 2"]:
        """Returns the derivatives of each camera's residual by its fx and fy."""
        return np.stack([4.0 * self.fy, -4.0 * self.fx], axis=1) / ((self.fx + self.fy)[:, None] ** 2 * ASPECT_PRIOR)

    def add_to(self, equations: NormalEquations) -> None:
        """Adds the term to the normal equations."""
        for camera, (slope, residual) in enumerate(zip(self.slopes(), self.residual, strict=True)):
            block = slice(camera * PER_CAMERA, camera * PER_CAMERA + 2)
            equations.matrix[block, block] += np.outer(slope, slope)
            equations.gradient[block] += slope * residual


def weak_prior(sizes: Sequence[tuple[int, int]]) -> LensPrior:
    """Returns wide priors of the intrinsics that suit any lens. The wide priors depend only on the image sizes (px)."""
    mean, sigma = [], []
    for width, height in sizes:
        long = max(width, height)
        mean.append([1.2 * long, 1.2 * long, (width - 1) / 2, (height - 1) / 2, 0, 0, 0, 0, 0])
        spread = [FOCAL_PRIOR * 1.2 * long] * 2 + [CENTRE_PRIOR * width, CENTRE_PRIOR * height]
        sigma.append(spread + [LENS_PRIOR[name] for name in INTRINSICS[4:]])
    information = np.stack([np.diag(np.array(row, dtype=float) ** -2) for row in sigma])
    return LensPrior(np.array(mean, dtype=float), information)
