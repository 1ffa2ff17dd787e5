"""Checks whether the Laplace posterior of a fit is the true posterior, by a Markov chain: preconditioned
Crank-Nicolson.

Cotter, Roberts, Stuart and White, *MCMC methods for functions*, Statistical Science 2013. With the fit's mode m and
covariance C, the proposal ``m + sqrt(1 - b^2) (x - m) + b N(0, C)`` leaves N(m, C) unchanged. A step is then accepted
by the difference between the cost and its quadratic approximation: always, if the posterior were Gaussian. If the
covariance is right, the chain's standard deviations divided by the Laplace ones are near 1.

Heads without hair, exact cameras, contours with Gaussian noise of 0.3 px whose size is stated (``limit``); unknowns are
coefficients, pose and scale. Half a cost is a negative log density. Chains run on the decimated mesh (``p95``), with
contours made from it, since a step must take less than a tenth of a second.
"""

from dataclasses import dataclass, replace

import numpy as np
from jaxtyping import Float

from pipeline.contour_fit.contour import run_stage
from pipeline.contour_fit.head_problem import apply_step, build_head_problem, started_problem
from pipeline.contour_fit.problem import PER_CAMERA, POSE, ContourProblem, Stage, State, first_evidence, make_problem
from pipeline.head_model.model import HeadModel, with_modes
from rig.render.renderer import Renderer
from rig.rig import Rig
from rig.studio.scene.layout import default_layout
from tests.laboratory.experiments.paper.limit import CORRELATION_PX, UNROBUST_PX, settings_for, with_noise
from tests.laboratory.experiments.records import CONTOUR, Bench, Outcome, Row, key_of
from tests.support.subjects import Planted, exact, exact_silhouettes, face_rows, random_subjects

NOISE_PX = 0.3
BETA = 0.2  # of a proposal
STEPS, FORGOTTEN = 12_000, 2_000


@dataclass(frozen=True, slots=True, eq=False)
class Chain:
    """Holds the chain's draws, as steps from the mode (coefficients, rotation, translation, log scale), and the share
    of accepted proposals."""

    draws: Float[np.ndarray, "n p"]
    accepted: float


def posterior_check(model: HeadModel, *, renderer: Renderer, bench: Bench, subjects: int = 3) -> Outcome:
    """Runs this module's experiment. Returns the chain's standard deviations divided by the Laplace ones: of
    coefficients and pose, and of the face's points along the axes."""
    records = bench.records("posterior", key_of(model.sha256, *CONTOUR, STEPS, BETA))
    span, rig = with_modes(model, 60), exact(default_layout())
    rows = []
    for i, subject in enumerate(random_subjects(subjects, seed=22)):
        rows.append(records.row(subject.name, lambda s=subject, n=i: _row(span, s, rig, renderer, n), i / subjects))
    figures = {quantity: float(np.mean([row[quantity] for row in rows])) for quantity in rows[0]}
    return {"figures": {"subjects": len(rows), **figures}, "rows": rows}


def _row(model: HeadModel, subject: Planted, rig: Rig, renderer: Renderer, number: int) -> Row:
    rng = np.random.default_rng([22, number])
    clean = exact_silhouettes(model, subject, rig, renderer, level="p95")
    noisy = {name: with_noise(silhouette, NOISE_PX, CORRELATION_PX, rng) for name, silhouette in clean.items()}
    problem = make_problem(model, subject.start, noisy, rig, settings_for(NOISE_PX), {}, levels=("p95",))
    stage = Stage("p95", len(model.modes), False, (20.0, 6.0, UNROBUST_PX), True, True, 12)
    state = State(np.zeros(0), subject.start, np.zeros((len(rig), PER_CAMERA)))
    evidence = first_evidence(problem.settings)
    mode, _, _ = run_stage(problem, evidence, state, stage, lambda fraction: None)
    whole = build_head_problem(problem, evidence, stage, UNROBUST_PX)
    covariance = np.linalg.inv(whole.equations(whole.at(mode)).matrix)
    chain = run_chain(problem, mode, stage, covariance, rng)
    found, laplace = np.cov(chain.draws.T), covariance
    ratio = np.sqrt(np.diag(found) / np.diag(laplace))
    face = face_rows(model, mode.coefficients, mode.world_from_head, every=301)
    points = np.sqrt(np.einsum("np,pq,nq->n", face, found, face) / np.einsum("np,pq,nq->n", face, laplace, face))
    shift = chain.draws.mean(axis=0) / np.sqrt(np.diag(laplace))
    return {
        "accepted": chain.accepted,
        "coefficient_ratio": float(ratio[:-POSE].mean()),
        "pose_ratio": float(ratio[-POSE:].mean()),
        "face_ratio": float(points.mean()),
        "face_ratio_least": float(points.min()),
        "face_ratio_most": float(points.max()),
        "mean_shift_sigma": float(np.sqrt((shift**2).mean())),
    }


def run_chain(
    problem: ContourProblem,
    mode: State,
    stage: Stage,
    covariance: Float[np.ndarray, "p p"],
    rng: np.random.Generator,
    steps: int = STEPS,
) -> Chain:
    """Runs the chain from the mode, and returns its draws without the first ``FORGOTTEN``."""
    factor = np.linalg.cholesky(covariance)
    whole, _ = started_problem(problem, first_evidence(problem.settings), stage, UNROBUST_PX, mode)

    def beyond(white: Float[np.ndarray, " p"]) -> float:
        """Returns negative log density at ``mode + factor @ white``, less that of N(mode, covariance)."""
        state = apply_step(mode, factor @ white, replace(stage, cameras=False))
        return 0.5 * whole.at(state).cost - 0.5 * float(white @ white)

    now = np.zeros(len(covariance))
    there, accepted, draws = beyond(now), 0, []
    for _ in range(steps):
        then = np.sqrt(1.0 - BETA**2) * now + BETA * rng.standard_normal(len(now))
        value = beyond(then)
        if np.log(rng.uniform()) < there - value:
            now, there, accepted = then, value, accepted + 1
        draws.append(factor @ now)
    return Chain(np.array(draws[FORGOTTEN:]), accepted / steps)
