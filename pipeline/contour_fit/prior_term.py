"""Computes the prior on shape, expression, scale and cameras. Shape coefficients are z ~ N(0, I), expressions are
sparse, the scale is near 1, and cameras follow their calibration within its covariance.

Most faces are neutral or combine few expressions. The prior of an expression's weight therefore has a heavy tail:

    p(w) ~ (1 + w / t)^-2 N(w; 0, 1),    0 <= w <= 1

The first factor of the prior is Lomax's distribution (1954) of shape 1, whose median is t. Lomax's distribution
suppresses small weights that explain little, and hardly penalises large weights, unlike a Gaussian or an exponential
prior. The normal equations replace the cost's logarithm by its tangent, which lies above it, so a step that lowers the
tangent also lowers the logarithm (Candes, Wakin and Boyd 2008, *Enhancing sparsity by reweighted l1 minimization*).
``head_problem`` bounds the weights.

The priors of the coefficients, of log scale and of each camera's correction are Gaussian.
"""

from dataclasses import dataclass

import numpy as np
from jaxtyping import Float

from pipeline.contour_fit.problem import PER_CAMERA, POSE, ContourProblem, Stage, State
from pipeline.estimation.terms import NormalEquations

EXPRESSION_MEDIAN = 0.1  # t of the prior above
SCALE_SPREAD = 0.01  # standard deviation of log scale: rigs are metric, and size is a mode
LOG_SCALE = 6  # its place in the pose
TAIL = 2.0  # exponent of the weights' prior


def weights_of(problem: ContourProblem, coefficients: Float[np.ndarray, " m"]) -> Float[np.ndarray, " e"]:
    """Returns the expression weights among the coefficients; negative weights become 0. The array is empty if the stage
    does not solve for expressions."""
    return np.maximum(coefficients[problem.model.posed.start : problem.model.posed.stop], 0.0)


def weight_slope(weights: Float[np.ndarray, " e"]) -> Float[np.ndarray, " e"]:
    """Returns ``TAIL / (t + w)`` for each expression weight w, where t is ``EXPRESSION_MEDIAN``. The slope is half the
    derivative of ``2 TAIL log(1 + w / t)``, the heavy-tailed factor of the weights' prior."""
    return TAIL / (EXPRESSION_MEDIAN + weights)


@dataclass(frozen=True, slots=True, eq=False)
class PriorTerm:
    """Computes the cost of the prior as a function of shape, pose and camera corrections."""

    problem: ContourProblem
    stage: Stage

    def at(self, state: State) -> "LinearisedPriorTerm":
        """Returns the prior, linearised at ``state``."""
        return LinearisedPriorTerm(self, state)


@dataclass(frozen=True, slots=True, eq=False)
class LinearisedPriorTerm:
    """Holds the prior linearised at one state of the solver."""

    term: PriorTerm
    state: State

    @property
    def cost(self) -> float:
        """Returns minus twice the logarithm of the prior density, up to a constant."""
        state, problem = self.state, self.term.problem
        shape = float(state.coefficients @ state.coefficients)
        weights = weights_of(problem, state.coefficients)
        shape += 2.0 * TAIL * float(np.log1p(weights / EXPRESSION_MEDIAN).sum())
        cameras = float(np.einsum("ki,kij,kj->", state.camera_shift, problem.camera_information, state.camera_shift))
        return shape + cameras + (np.log(state.world_from_head.scale) / SCALE_SPREAD) ** 2

    def add_to(self, equations: NormalEquations) -> None:
        """Adds the prior to the normal equations, in place. The prior of cameras is included only if the stage solves
        for camera corrections."""
        state, problem, m = self.state, self.term.problem, self.term.stage.modes
        equations.matrix[np.arange(m), np.arange(m)] += 1.0
        equations.gradient[:m] += state.coefficients
        weights, first = weights_of(problem, state.coefficients), problem.model.posed.start
        slope = weight_slope(weights)
        equations.gradient[first : first + len(weights)] += slope
        information = SCALE_SPREAD**-2
        equations.matrix[m + LOG_SCALE, m + LOG_SCALE] += information
        equations.gradient[m + LOG_SCALE] += np.log(state.world_from_head.scale) * information
        if self.term.stage.cameras:
            for k, known in enumerate(problem.camera_information):
                block = slice(m + POSE + PER_CAMERA * k, m + POSE + PER_CAMERA * (k + 1))
                equations.matrix[block, block] += known
                equations.gradient[block] += known @ state.camera_shift[k]
