"""Adjusts intrinsics with distortion, camera poses and board poses together, with a robust loss.

Levenberg-Marquardt minimises the cost; ``CornerTerm`` adds each view's block to the normal equations. Eleven cameras
and thirty shots have 339 unknowns. A dense Cholesky factor solves this system in ten milliseconds, so a sparse solver
would gain nothing (tests/laboratory/notes/calibration.md compares the times with those of scipy and Ceres).

The cost is ``sum rho(|r|^2 / sigma_c^2) + priors``. The loss rho is Cauchy's during the search for outliers and Huber's
at the end; sigma_c is the corner noise of camera c."""

from collections.abc import Callable
from dataclasses import dataclass, field

import numpy as np
from jaxtyping import Bool, Float, Int

from calibration.adjustment.lens_prior import AspectTerm, LensPrior
from calibration.adjustment.state import (
    DEPTH_LEAST_MM,
    INTRINSICS,
    PER_CAMERA,
    PER_SHOT,
    BundleState,
    Observations,
    corner_positions,
    moved_state,
    residuals,
)
from pipeline.estimation.levenberg_marquardt import Evidence, Limits, minimise
from pipeline.estimation.positive_definite import inverse
from pipeline.estimation.robust import Cauchy, Huber, LeastSquares, Loss
from pipeline.estimation.terms import NormalEquations, Problem
from rig.camera import lens_jacobians
from rig.geometry import cross_matrix


@dataclass(frozen=True, slots=True, eq=False)
class CornerTerm:
    """Computes the cost of all corners as a function of the state. ``sigma_px`` is each camera's standard deviation of
    a corner's coordinate."""

    seen: Observations
    sigma_px: Float[np.ndarray, " c"]
    loss: Loss = field(default_factory=LeastSquares)

    def at(self, state: BundleState) -> "LinearisedCornerTerm":
        """Returns the term at a state."""
        noise = self.sigma_px[self.seen.camera[self.seen.view_of]]
        return LinearisedCornerTerm(self, state, residuals(state, self.seen) / noise[:, None], noise)


@dataclass(frozen=True, slots=True, eq=False)
class LinearisedCornerTerm:
    """Holds the residuals of all corners at one state."""

    term: CornerTerm
    state: BundleState
    residual: Float[np.ndarray, "n 2"]  # in standard deviations
    noise_px: Float[np.ndarray, " n"]

    @property
    def cost(self) -> float:
        """Returns the sum of the robust loss over all corners."""
        return float(self.term.loss.cost((self.residual**2).sum(axis=1)).sum())

    def add_to(self, equations: NormalEquations) -> None:
        """Adds the blocks of all views to the normal equations."""
        observed, cameras = self.term.seen, len(self.state.intrinsics)
        weight = np.sqrt(self.term.loss.weight((self.residual**2).sum(axis=1)))
        blocks = np.concatenate([self.by_view(), self.residual[:, :, None]], axis=2)
        blocks = (blocks * weight[:, None, None]).reshape(2 * len(self.residual), -1)
        for view, at in enumerate(places(observed, cameras, len(equations.gradient))):
            block = blocks[2 * observed.starts[view] : 2 * observed.starts[view + 1]]
            product = block.T @ block
            equations.matrix[np.ix_(at, at)] += product[:-1, :-1]
            equations.gradient[at] += product[:-1, -1]

    def by_view(self) -> Float[np.ndarray, "n 2 22"]:
        """Returns the derivatives of each corner's pixel by the 22 parameters of its view, in the order of
        ``places``."""
        state, observed = self.state, self.term.seen
        world, inside, camera = corner_positions(state, observed)
        behind = inside[:, 2] < DEPTH_LEAST_MM
        inside[behind] = (0.0, 0.0, 1.0)
        by_point, by_lens = lens_jacobians(inside, state.intrinsics[camera])
        by_world = by_point @ state.camera_rotations[camera]
        by_board = np.concatenate([-by_world @ cross_matrix(world), by_world], axis=2)
        by_offset = by_board @ state.velocities[observed.shot[observed.view_of]][:, :, None]
        by_camera = [by_lens, -by_point @ cross_matrix(inside), by_point]
        rows = np.concatenate([*by_camera, by_board, by_offset], axis=2)
        rows[behind] = 0.0
        rows /= self.noise_px[:, None, None]
        return rows


def places(observed: Observations, cameras: int, size: int) -> Int[np.ndarray, "v 22"]:
    """Returns, for each view, the indices of its 22 parameters: camera (15), board (6) and time offset (1)."""
    of_camera = observed.camera[:, None] * PER_CAMERA + np.arange(PER_CAMERA)
    board = cameras * PER_CAMERA + observed.shot[:, None] * PER_SHOT + np.arange(PER_SHOT)
    return np.concatenate([of_camera, board, size - cameras + observed.camera[:, None]], axis=1)


CAUCHY = Cauchy(2.0)  # scale in standard deviations; used while outliers are sought
HUBER = Huber(2.0)  # scale in standard deviations; leaves 86 % of a Gaussian's 2D residuals unchanged
TOLERANCE = 1e-5  # predicted fall of the cost, in squared standard deviations, at which the adjustment ends
STEPS_MOST = 60


@dataclass(frozen=True, slots=True)
class Free:
    """Selects which kinds of parameters the adjustment changes. The pose of the first camera is always fixed, since it
    defines the world frame."""

    intrinsics: bool = True
    poses: bool = True
    boards: bool = True
    offsets: bool = False


@dataclass(frozen=True, slots=True, eq=False)
class BundleSolution:
    """Holds the final state of the adjustment, and the normal matrix of the parameters that ``free`` marks."""

    state: BundleState
    normal: Float[np.ndarray, "p p"]  # of the free parameters, at the solution, residuals in sigmas
    free: Bool[np.ndarray, " q"]
    evidence: Evidence

    @property
    def cost(self) -> float:
        """Returns the cost at the solution."""
        return self.evidence.cost

    def covariance(self) -> Float[np.ndarray, "q q"]:
        """Returns the covariance of all parameters in the order cameras (intrinsics, pose), boards, time offsets. The
        covariance's rows and columns of fixed parameters are zero."""
        full = np.zeros((len(self.free), len(self.free)))
        # Scaled to a unit diagonal first: parameters span from 1e-4 (distortion) to 1e3 (mm).
        scale = 1.0 / np.sqrt(np.maximum(np.diag(self.normal), 1e-12))
        scaled = self.normal * np.outer(scale, scale)
        try:
            covariance = inverse(scaled)
        except np.linalg.LinAlgError:
            covariance = inverse(scaled + 1e-9 * np.eye(len(scale)))  # gives undetermined parameters a huge variance
        full[np.ix_(self.free, self.free)] = covariance * np.outer(scale, scale)
        return full


def corner_sigma(
    state: BundleState, observed: Observations, lens_noise: Float[np.ndarray, " c"]
) -> tuple[Float[np.ndarray, " c"], float]:
    """Returns the noise (px) of each camera's corners in the joint solution, and the noise that all cameras share.

    ``lens_noise`` is the corner noise in each camera's separate calibration. Residuals of the joint solution are larger
    than this noise if cameras were not exactly simultaneous, or if the board bends. The excess is one variance for all
    cameras. With a variance for each camera, the fit could declare one camera noisy and fit the others exactly."""
    squares = (residuals(state, observed) ** 2).sum(axis=1)
    typical = float(np.median(squares)) / 1.1774**2
    shared = max(0.0, typical - float(np.median(lens_noise[observed.camera[observed.view_of]] ** 2)))
    return np.sqrt(lens_noise**2 + shared), float(np.sqrt(shared))


def adjust(
    state: BundleState,
    observed: Observations,
    prior: LensPrior,
    sigma: Float[np.ndarray, " c"],
    *,
    free: Free | None = None,
    loss: Loss | None = None,
    steps: int = STEPS_MOST,
    tick: Callable[[], None] = lambda: None,
) -> BundleSolution:
    """Minimises the cost of the bundle adjustment, starting from ``state``.

    ``observed`` holds the corners of all views, and ``prior`` the prior of the intrinsics. ``sigma`` is each camera's
    noise of a corner's coordinate, px. ``free`` selects the parameters that change: by default all but the time
    offsets. ``loss`` is the robust loss of |r|^2 / sigma^2; the default is least squares. ``steps`` is the largest
    number of steps. ``tick`` is called before every step; an exception raised by ``tick`` ends the adjustment.
    """
    problem = build_bundle_problem(state, CornerTerm(observed, sigma, loss or LeastSquares()), prior, free or Free())
    limits = Limits(steps=steps, tolerance=TOLERANCE, tries=6, first_damping=1e-4)
    solution = minimise(problem, state, limits, watch=tick)
    assert problem.free is not None
    return BundleSolution(solution.value, problem.equations(solution.at).matrix, problem.free, solution.evidence)


def build_bundle_problem(state: BundleState, corners: CornerTerm, prior: LensPrior, free: Free) -> Problem[BundleState]:
    """Builds the least-squares problem from the corner term, the lens priors and the prior of square pixels."""
    mask = free_mask(state, free)
    return Problem((corners, prior, AspectTerm()), len(mask), moved_state, mask)


def free_mask(state: BundleState, free: Free) -> Bool[np.ndarray, " q"]:
    """Returns a mask over all parameters, True for those that change."""
    cameras, shots = len(state.intrinsics), len(state.board_rotations)
    per_camera = np.zeros((cameras, PER_CAMERA), dtype=bool)
    per_camera[:, : len(INTRINSICS)] = free.intrinsics
    per_camera[1:, len(INTRINSICS) :] = free.poses
    offsets = np.full(cameras, free.offsets)
    offsets[0] = False
    return np.concatenate([per_camera.ravel(), np.full(shots * PER_SHOT, free.boards), offsets])
