"""What is known of a head before it is seen: z ~ N(0, I), few expressions, a metric scale, the cameras' covariance.

Most faces are neutral, and those that are not make few expressions at a time: the weight of one is a Gaussian
``N(-s^2 / tau, s^2)`` cut to 0..1, which near zero is the exponential of mean ``tau``: a small weight must explain more
than it costs, and a large one that shows is hardly held back. Its bounds are ``head_problem``'s.

The Gaussian priors of the coefficients, of log scale (rigs are metric) and of each camera's correction, as one term.
"""

from dataclasses import dataclass

import numpy as np
from jaxtyping import Float

from pipeline.estimation.terms import NormalEquations
from pipeline.fitting.problem import PER_CAMERA, POSE, ContourProblem, Stage, State

LOG_SCALE = 6  # its place in the pose


def coefficient_prior(
    problem: ContourProblem, coefficients: Float[np.ndarray, " m"]
) -> tuple[Float[np.ndarray, " m"], Float[np.ndarray, " m"]]:
    """How far coefficients are off their prior's middle, and that prior's information."""
    posed, settings = slice(problem.model.posed.start, problem.model.posed.stop), problem.settings
    off, information = coefficients.copy(), np.ones(len(coefficients))
    off[posed] += settings.expression_spread**2 / settings.expression_mean
    information[posed] = settings.expression_spread**-2
    return off, information


@dataclass(frozen=True, slots=True, eq=False)
class PriorTerm:
    """Over (coefficients, pose, cameras where they are solved for)."""

    problem: ContourProblem
    stage: Stage

    def at(self, state: State) -> "PriorAt":
        return PriorAt(self, state)


@dataclass(frozen=True, slots=True, eq=False)
class PriorAt:
    """The priors at one state."""

    term: PriorTerm
    state: State

    @property
    def cost(self) -> float:
        state, problem = self.state, self.term.problem
        off, information = coefficient_prior(problem, state.coefficients)
        shape = float(information @ off**2)
        cameras = float(np.einsum("ki,kij,kj->", state.camera_shift, problem.camera_information, state.camera_shift))
        return shape + cameras + (np.log(state.world_from_head.scale) / problem.settings.scale_spread) ** 2

    def add_to(self, equations: NormalEquations) -> None:
        state, problem, m = self.state, self.term.problem, self.term.stage.modes
        off, spread = coefficient_prior(problem, state.coefficients)
        equations.matrix[np.arange(m), np.arange(m)] += spread
        equations.gradient[:m] += spread * off
        information = problem.settings.scale_spread**-2
        equations.matrix[m + LOG_SCALE, m + LOG_SCALE] += information
        equations.gradient[m + LOG_SCALE] += np.log(state.world_from_head.scale) * information
        if self.term.stage.cameras:
            for k, known in enumerate(problem.camera_information):
                block = slice(m + POSE + PER_CAMERA * k, m + POSE + PER_CAMERA * (k + 1))
                equations.matrix[block, block] += known
                equations.gradient[block] += known @ state.camera_shift[k]
