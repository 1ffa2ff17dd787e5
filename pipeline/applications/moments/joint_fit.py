"""Estimates one identity common to several captures, together with the pose, expression and cameras of each capture.

The input is the contour solver's solution for every capture, fitted to outlines or photographs. The output is each
capture's solution with one common identity. The identity's coefficients and the logarithm of scale are shared; each
other unknown belongs to one capture. The normal equations therefore have the form of an arrow: a shared block, and one
block for each capture (module ``arrow``).

The cost is the sum of the captures' costs. Each capture's cost contains the prior of the shared unknowns, so the sum
contains this prior K times for K captures. If the captures' errors were independent, the prior should count once. The
errors of cameras, light, hair and head model are the same in all captures. If the fraction ``COMMON`` of the error
variance is common, K captures are worth K / (1 + COMMON (K - 1)) independent ones; the prior should therefore count 1 +
COMMON (K - 1) times. When the prior counted once, the joint head of eight captures from three cameras was no better
than the mean of the separate heads.

A capture whose photographs lack detail has no fine modes; it contributes only to the modes that it has."""

from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass, replace

import numpy as np
from jaxtyping import Float, Int

from pipeline.applications.moments.arrow import Arrow
from pipeline.compute.trace import traced
from pipeline.contour_fit.contour import NON_MONOTONE, TOLERANCE, TRIES, ContourSolution, hold_at_bounds, last_problem
from pipeline.contour_fit.expression_evidence import ROUNDS, estimate_variance, makes_face
from pipeline.contour_fit.head_problem import weight_bounds
from pipeline.contour_fit.prior_term import LOG_SCALE, SCALE_SPREAD, weight_slope
from pipeline.contour_fit.problem import POSE, State
from pipeline.estimation.levenberg_marquardt import Limits, minimise
from pipeline.estimation.positive_definite import inverse
from pipeline.estimation.terms import Linearised, NormalEquations, Problem, Sum

COMMON = 0.5  # share of the error variance that all captures have in common
STEPS = 12  # Levenberg-Marquardt steps at most
States = tuple[State, ...]
Rows = Int[np.ndarray, "_"]


@dataclass(frozen=True, slots=True, eq=False)
class Layout:
    """Holds the index of each capture's unknowns in the vector of all unknowns: identity coefficients first, then the
    logarithm of scale, then each capture's remaining unknowns."""

    identity: int  # coefficients
    places: tuple[Rows, ...]  # by moment: the row of each of its unknowns
    weights: tuple[Rows, ...]  # by moment: the rows of its expression weights
    free: tuple[Rows, ...]  # by moment: the rows of its own unknowns without bounds: pose and cameras
    size: int

    @property
    def arrow(self) -> Arrow:
        """Returns the arrow structure, in which the shared unknowns and the expression weights are not eliminated."""
        return Arrow(self.size, self.free)


def identity_of(solved: ContourSolution, state: State) -> Float[np.ndarray, " i"]:
    """Returns the coefficients of a capture's head without expression weights."""
    return np.delete(state.coefficients, np.asarray(solved.problem.model.posed, int))


def lay_out(solutions: Sequence[ContourSolution], problems: Sequence[Problem[State]]) -> Layout:
    """Returns the layout of all captures' unknowns in one vector."""
    identity = max(len(identity_of(each, each.state)) for each in solutions)
    places, weights, free, size = [], [], [], identity + 1
    for solved, problem in zip(solutions, problems, strict=True):
        modes, posed = solved.stage.modes, np.asarray(solved.problem.model.posed, int)
        shared = np.append(np.setdiff1d(np.arange(modes), posed), modes + LOG_SCALE)
        local = np.setdiff1d(np.arange(problem.unknowns), shared)
        rows = np.empty(problem.unknowns, int)
        rows[shared], rows[local] = np.arange(len(shared)), np.arange(size, size + len(local))
        rows[modes + LOG_SCALE], size = identity, size + len(local)
        places.append(rows)
        weights.append(rows[posed])
        free.append(rows[np.setdiff1d(local, posed)])
    return Layout(identity, tuple(places), tuple(weights), tuple(free), size)


@dataclass(frozen=True, slots=True, eq=False)
class JointTerm:
    """Computes the sum of the costs of all captures. For K captures, the prior of the shared unknowns is multiplied by
    ``1 + common (K - 1)``."""

    problems: tuple[Problem[State], ...]
    solutions: tuple[ContourSolution, ...]
    layout: Layout
    common: float

    def at(self, states: States) -> "LinearisedJointTerm":
        """Returns the linearised term; ``states`` has one state for each capture."""
        parts = tuple(problem.at(state) for problem, state in zip(self.problems, states, strict=True))
        counts = np.zeros(self.layout.identity + 1)  # priors too many
        values = np.zeros(self.layout.identity + 1)
        for solved, state in zip(self.solutions, states, strict=True):
            shared = identity_of(solved, state)
            counts[: len(shared)] += 1.0
            values[: len(shared)] = shared
        counts[-1], values[-1] = len(states), np.log(states[0].world_from_head.scale)
        information = np.append(np.ones(self.layout.identity), SCALE_SPREAD**-2)
        return LinearisedJointTerm(self, parts, (1.0 - self.common) * (counts - 1.0) * information, values)


@dataclass(frozen=True, slots=True, eq=False)
class LinearisedJointTerm:
    """Holds the captures' linearised costs, and the information matrix of the superfluous copies of the prior, which is
    subtracted at the shared ``values``."""

    term: JointTerm
    parts: tuple[Linearised, ...]
    repeated: Float[np.ndarray, " s"]
    values: Float[np.ndarray, " s"]

    @property
    def cost(self) -> float:
        """Returns the sum of the captures' costs, without the superfluous copies of the prior."""
        return sum(part.cost for part in self.parts) - float(self.repeated @ self.values**2)

    def add_to(self, equations: NormalEquations) -> None:
        """Adds each capture's normal equations at its indices, in place."""
        layout = self.term.layout
        for part, problem, rows in zip(self.parts, self.term.problems, layout.places, strict=True):
            local = problem.equations(part)
            equations.matrix[np.ix_(rows, rows)] += local.matrix
            equations.gradient[rows] += local.gradient
        shared = np.arange(layout.identity + 1)
        equations.matrix[shared, shared] -= self.repeated
        equations.gradient[shared] -= self.repeated * self.values


def build_joint_problem(solutions: Sequence[ContourSolution], common: float = COMMON) -> tuple[Problem[States], Layout]:
    """Builds the least-squares problem of all captures, from the last stage of each capture's solution."""
    problems = tuple(last_problem(each)[0] for each in solutions)
    layout = lay_out(solutions, problems)
    term = JointTerm(problems, tuple(solutions), layout, common)

    def moved(states: States, step: Float[np.ndarray, " p"]) -> States:
        triples = zip(problems, states, layout.places, strict=True)
        return tuple(problem.after(state, step[rows]) for problem, state, rows in triples)

    def room(states: States) -> tuple[Float[np.ndarray, " p"], Float[np.ndarray, " p"]]:
        lower, upper = np.full(layout.size, -np.inf), np.full(layout.size, np.inf)
        for solved, state, rows, weights in zip(solutions, states, layout.places, layout.weights, strict=True):
            least, most = weight_bounds(state, solved.problem, len(rows))
            posed = np.asarray(solved.problem.model.posed, int)
            lower[weights], upper[weights] = least[posed], most[posed]
        return lower, upper

    return Problem((term,), layout.size, moved, room=room), layout


def start_at_mean(solutions: Sequence[ContourSolution]) -> States:
    """Returns each capture's state with its identity and scale replaced by the mean over all captures. For a mode that
    some captures lack, the mean is taken over the others."""
    identities = [identity_of(each, each.state) for each in solutions]
    stacked = np.full((len(solutions), max(map(len, identities))), np.nan)
    for row, identity in zip(stacked, identities, strict=True):
        row[: len(identity)] = identity
    mean = np.nanmean(stacked, axis=0)
    scale = float(np.exp(np.mean([np.log(each.state.world_from_head.scale) for each in solutions])))
    return tuple(with_identity(each, each.state, mean, scale) for each in solutions)


def with_identity(solved: ContourSolution, state: State, identity: Float[np.ndarray, " i"], scale: float) -> State:
    """Returns a capture's state with the given identity (truncated to the capture's modes) and scale."""
    coefficients, posed = state.coefficients.copy(), np.asarray(solved.problem.model.posed, int)
    rows = np.setdiff1d(np.arange(len(coefficients)), posed)
    coefficients[rows] = identity[: len(rows)]
    return replace(state, coefficients=coefficients, world_from_head=replace(state.world_from_head, scale=scale))


@traced
def fit_jointly(
    solutions: Sequence[ContourSolution], eigenheads: int, *, watch: Callable[[], None] = lambda: None
) -> tuple[ContourSolution, ...]:
    """Returns the captures' solutions after a joint fit that gives all of them the same identity.

    Args:
        solutions: those of at least two captures, with the same mesh and basis; some may also have fine modes.
        eigenheads: the number of eigenheads, which are the first modes.
        watch: called before every step; an exception that it raises ends the fit.
    """
    problem, layout = build_joint_problem(solutions)
    limits, arrow = Limits(STEPS, TOLERANCE, TRIES, NON_MONOTONE), layout.arrow
    found = minimise(problem, start_at_mean(solutions), limits, solve=arrow.solve, least=arrow.least, watch=watch)
    states = found.value
    if any(
        makes_face(state.coefficients, solved.problem.model.posed)
        for solved, state in zip(solutions, states, strict=True)
    ):
        states = _with_evidence(solutions, problem, layout, states, found.at, eigenheads)
    return tuple(
        replace(solved, state=state, evaluations=solved.evaluations + found.evidence.evaluations)
        for solved, state in zip(solutions, states, strict=True)
    )


def _with_evidence(
    solutions: Sequence[ContourSolution],
    problem: Problem[States],
    layout: Layout,
    states: States,
    here: Linearised,
    eigenheads: int,
) -> States:
    """Estimates the prior variance of each group of modes from all captures and solves once more for shape and
    expressions, as ``expression_evidence`` does for one capture."""
    longest = max(range(len(states)), key=lambda k: len(states[k].coefficients))
    posed = solutions[longest].problem.model.posed
    identity = identity_of(solutions[longest], states[longest])
    diagonal = np.arange(layout.identity)
    groups = (diagonal[:eigenheads], diagonal[eigenheads : posed.start], diagonal[posed.start :])
    equations = problem.equations(here)
    matrix, gradient = equations.matrix, equations.gradient
    priors = 1.0 + COMMON * (len(states) - 1)
    matrix[diagonal, diagonal] -= priors  # the information without the priors
    gradient[diagonal] -= priors * identity
    before = [
        state.coefficients[solved.problem.model.posed.start : solved.problem.model.posed.stop]
        for solved, state in zip(solutions, states, strict=True)
    ]
    for rows, weights in zip(layout.weights, before, strict=True):
        gradient[rows] -= weight_slope(np.maximum(weights, 0.0))
    variance, step, arrow = np.ones(layout.identity), np.zeros(layout.size), layout.arrow
    assert problem.room is not None
    room = problem.room(states)
    for _ in range(ROUNDS):
        whole, slope = matrix.copy(), gradient.copy()
        whole[diagonal, diagonal] += priors / variance
        slope[diagonal] += priors * identity / variance
        for rows, weights in zip(layout.weights, before, strict=True):
            slope[rows] += weight_slope(np.maximum(weights + step[rows], 0.0))
        step = arrow.least(whole, slope, *room)
        covariance = priors * arrow.variances(whole)
        for group in groups:
            variance[group] = estimate_variance(identity + step[diagonal], covariance, variance, group)
    return problem.after(states, step)


def joint_covariances(solutions: Sequence[ContourSolution]) -> Iterator[Float[np.ndarray, "p p"]]:
    """Yields the covariance of each capture's coefficients, rotation, translation and log scale after the joint fit.
    The independent part of the errors follows from the joint normal matrix; the common part, the fraction ``COMMON``,
    keeps the covariance of the capture's separate fit. Weights at bounds get the variance that ``finish`` defines."""
    problem, layout = build_joint_problem(solutions, common=0.0)
    here = problem.at(tuple(each.state for each in solutions))
    assert isinstance(here, Sum)
    (joint,) = here.parts
    assert isinstance(joint, LinearisedJointTerm)
    whole, alone = problem.equations(here), []
    for solved, own_problem, part, rows in zip(solutions, joint.term.problems, joint.parts, layout.places, strict=True):
        held = NormalEquations(np.zeros((len(rows), len(rows))), whole.gradient[rows])
        hold_at_bounds(solved, held)
        whole.matrix[np.ix_(rows, rows)] += held.matrix
        kept = solved.stage.modes + POSE
        alone.append(inverse(own_problem.equations(part).matrix + held.matrix)[:kept, :kept])
    blocks = tuple(rows[: len(local)] for rows, local in zip(layout.places, alone, strict=True))
    for local, together in zip(alone, layout.arrow.covariances(whole.matrix, blocks), strict=True):
        yield COMMON * local + (1.0 - COMMON) * together
