"""What is known of a head before it is seen: z ~ N(0, I), a metric scale, and the calibration's covariance.

The Gaussian priors of the coefficients, of log scale (rigs are metric) and of each camera's correction, as one term.
"""

from dataclasses import dataclass

import numpy as np

from pipeline.estimation.terms import NormalEquations
from pipeline.fitting.problem import PER_CAMERA, POSE, ContourProblem, Stage, State

LOG_SCALE = 6  # its place in the pose


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
        shape = float(state.coefficients @ state.coefficients)
        cameras = float(np.einsum("ki,kij,kj->", state.camera_shift, problem.camera_information, state.camera_shift))
        return shape + cameras + (np.log(state.world_from_head.scale) / problem.settings.scale_spread) ** 2

    def add_to(self, equations: NormalEquations) -> None:
        state, problem, m = self.state, self.term.problem, self.term.stage.modes
        equations.matrix[np.arange(m), np.arange(m)] += 1.0
        equations.gradient[:m] += state.coefficients
        information = problem.settings.scale_spread**-2
        equations.matrix[m + LOG_SCALE, m + LOG_SCALE] += information
        equations.gradient[m + LOG_SCALE] += np.log(state.world_from_head.scale) * information
        if self.term.stage.cameras:
            for k, known in enumerate(problem.camera_information):
                block = slice(m + POSE + PER_CAMERA * k, m + POSE + PER_CAMERA * (k + 1))
                equations.matrix[block, block] += known
                equations.gradient[block] += known @ state.camera_shift[k]
