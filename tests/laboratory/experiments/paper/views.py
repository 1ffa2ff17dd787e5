"""Plans where cameras should stand: an A-optimal choice from the Fisher information of the rim, which the paper leaves
open (section 6), compared with its four arrangements of eleven (section 5.3).

Candidates lie on the sphere of the paper's cameras: azimuth -90 to 90 and elevation -40 to 40 degrees. The information
of a set of views is the sum of theirs plus the prior's. Pose and scale are unknown, and only the face's rim counts,
since hair and clothes hide the rest. The set is chosen greedily and improved by exchanges for the mean over some heads
of ``e^2 = tr(B I^-1 B^T) / V`` (fitting.md, the physical limit). It is scored on other heads: by the same limit, and by
the error of fits to heads with hair.
"""

from collections.abc import Callable, Sequence

import numpy as np
from jaxtyping import Float

from pipeline.contour_fit.head_problem import build_head_problem
from pipeline.contour_fit.prior_term import SCALE_SPREAD
from pipeline.contour_fit.problem import PER_CAMERA, POSE, Stage, State, first_evidence, make_problem
from pipeline.head_model.model import HeadModel, with_modes
from pipeline.imaging.silhouette import Silhouette
from pipeline.settings import FittingSettings
from rig.render.renderer import Renderer
from rig.rig import Rig
from rig.studio.scene.hair import HairStyle
from rig.studio.scene.layout import rig_from_directions
from tests.laboratory.experiments import markdown
from tests.laboratory.experiments.paper.limit import UNROBUST_PX, settings_for
from tests.laboratory.experiments.records import CONTOUR, Bench, Outcome, Row, key_of
from tests.support.layouts import ARRANGEMENTS_DEG, arrangement
from tests.support.subjects import (
    Planted,
    exact,
    face_rows,
    fit_contour,
    mean_error_mm,
    random_subjects,
    worn_silhouettes,
)

CANDIDATES_DEG = tuple((a, e) for e in range(-40, 41, 20) for a in range(-90, 91, 15))
VIEWS = 11
NOISE_PX = 0.3
CHOSEN_ON = 8  # heads
STYLE = HairStyle(thickness_mm=14.0, over_ears=True)
EXCHANGES = 3  # passes at most

Information = Float[np.ndarray, "k p p"]


def views(model: HeadModel, *, renderer: Renderer, bench: Bench, subjects: int = 12) -> Outcome:
    """Runs this module's experiment. Returns the planned directions, and limit and error of every arrangement over
    ``subjects`` heads that were not used for planning."""
    span = with_modes(model, 60)
    records = bench.records("views", key_of(model.sha256, *CONTOUR, CANDIDATES_DEG, STYLE))
    heads = random_subjects(CHOSEN_ON + subjects, seed=33)
    candidates = rig_from_directions(CANDIDATES_DEG)
    information = [
        _information(span, head, candidates, bench.report, i / len(heads)) for i, head in enumerate(heads[:CHOSEN_ON])
    ]
    chosen = a_optimal(information, VIEWS, prior(span))
    directions = [CANDIDATES_DEG[k] for k in chosen]
    rigs = {"planned": rig_from_directions(tuple(directions)), **{name: arrangement(name) for name in ARRANGEMENTS_DEG}}
    rows = []
    for i, head in enumerate(heads[CHOSEN_ON:]):
        bench.report(head.name, (CHOSEN_ON + i) / len(heads))
        for name, rig in rigs.items():
            key = f"{head.name} {name} {directions if name == 'planned' else ''}"
            row = records.row(key, lambda h=head, r=rig, n=i: _row(span, h, exact(r), renderer, n))
            rows.append({"name": head.name, "arrangement": name} | row)
    return _outcome(rows, tuple(rigs), directions)


def _outcome(rows: list[Row], names: tuple[str, ...], directions: list[tuple[int, int]]) -> Outcome:
    figures, table = {}, []
    for name in names:
        of = [row for row in rows if row["arrangement"] == name]
        limit = float(np.sqrt(np.mean([row["limit_mm"] ** 2 for row in of])))
        errors = np.array([row["error_mm"] for row in of])
        figures |= {f"{name}_limit_mm": limit, f"{name}_error_mm": float(errors.mean())}
        table.append([name, limit, float(errors.mean()), float(np.median(errors)), float(errors.max())])
    for quantity, figure in (("limit_mm", "planned_over_best_arrangement"), ("error_mm", "planned_error_over_best")):
        best = min(figures[f"{name}_{quantity}"] for name in names if name != "planned")
        figures[figure] = figures[f"planned_{quantity}"] / best
    header = ("arrangement", "limit, mm", "error with hair, mm", "median", "largest")
    text = "Planned (azimuth, elevation): " + ", ".join(f"({a}, {e})" for a, e in directions) + "\n\n"
    return {
        "figures": figures,
        "rows": rows,
        "planned_directions_deg": directions,
        "markdown": text + markdown.table(header, table),
    }


def _information(
    model: HeadModel, head: Planted, rig: Rig, report: Callable[[str, float], None], done: float
) -> tuple[Information, Float[np.ndarray, "p p"]]:
    report(f"information of {len(rig)} views of {head.name}", done)
    return information(model, head, rig), face_quadratic(model, head)


def _row(model: HeadModel, head: Planted, rig: Rig, renderer: Renderer, number: int) -> Row:
    silhouettes = worn_silhouettes(model, head, rig, renderer, STYLE, np.random.default_rng([33, number]))
    fit = fit_contour(model, head.start, silhouettes, rig, FittingSettings())
    total = information(model, head, rig).sum(axis=0) + prior(model)
    return {
        "error_mm": mean_error_mm(model, fit, head),
        "limit_mm": float(np.sqrt(np.trace(np.linalg.solve(total, face_quadratic(model, head))))),
    }


def information(model: HeadModel, head: Planted, rig: Rig) -> Information:
    """Returns the Fisher information of each camera about (coefficients, pose): the face's rim alone, exact cameras."""
    settings, pose = settings_for(NOISE_PX), head.world_from_head
    stage = Stage("p95", len(model.modes), False, (UNROBUST_PX,), False, False, 1)
    state = State(head.coefficients, pose, np.zeros((1, PER_CAMERA)))
    found = []
    for camera in exact(rig):
        k = camera.intrinsics
        flat = np.zeros((k.height, k.width), np.float32)  # no residual: the head is where the contour is
        seen = {camera.name: Silhouette(flat < 0, flat)}
        problem = make_problem(model, pose, seen, Rig((camera,)), settings, {}, levels=(stage.level,))
        whole = build_head_problem(problem, first_evidence(settings), stage, UNROBUST_PX)
        matrix = whole.equations(whole.at(state)).matrix
        found.append(matrix - prior(model))
    return np.stack(found)


def prior(model: HeadModel) -> Float[np.ndarray, "p p"]:
    """Returns the prior's information: z ~ N(0, I), no knowledge of the pose, a metric scale."""
    return np.diag([*np.ones(len(model.modes)), *np.zeros(POSE - 1), SCALE_SPREAD**-2.0])


def face_quadratic(model: HeadModel, head: Planted) -> Float[np.ndarray, "p p"]:
    """Returns ``B^T B / V`` over the face: with it ``tr(C B^T B / V)`` is the mean square error of a covariance C."""
    rows = face_rows(model, head.coefficients, head.world_from_head, every=7)  # smooth: every seventh vertex will do
    return 3.0 * rows.T @ rows / len(rows)


def a_optimal(
    heads: Sequence[tuple[Information, Float[np.ndarray, "_ _"]]], count: int, before: Float[np.ndarray, "p p"]
) -> list[int]:
    """Chooses ``count`` views with the smallest mean of ``tr(G (sum I_k + prior)^-1)``, greedily and then by exchanges.
    Returns their indices. ``heads`` has, for each head, the information of every candidate, and G."""

    def loss(chosen: list[int]) -> float:
        faint = 1e-9 * np.eye(len(before))  # one view alone leaves the pose open
        return sum(
            float(np.trace(np.linalg.solve(information[chosen].sum(axis=0) + before + faint, quadratic)))
            for information, quadratic in heads
        )

    everything = range(len(heads[0][0]))
    chosen: list[int] = []
    for _ in range(count):
        chosen.append(min((k for k in everything if k not in chosen), key=lambda k: loss([*chosen, k])))
    for _ in range(EXCHANGES):
        before_pass = loss(chosen)
        for i in range(count):
            rest = chosen[:i] + chosen[i + 1 :]
            best = min((k for k in everything if k not in rest), key=lambda k, rest=rest: loss([*rest, k]))
            chosen = [*rest[:i], best, *rest[i:]]
        if loss(chosen) > (1.0 - 1e-6) * before_pass:
            break
    return sorted(chosen)
