"""Compares this project's solver with others in one run, on the same subjects and masks.

The others search the 60 coefficients at the true pose, which is the best case for them: the paper never changes the
pose that the feature points give. This project's starts 2 degrees and 4 mm off, and has to find pose and scale as well.

- ``simplex``: scipy's Nelder-Mead as in the paper: eq. (5) on the renderer, its two levels (section 5.1), its initial
  simplex (section 4.4). A level ends at a relative spread of 1e-4 or 3,500 evaluations. Only the face's outline counts,
  which was better and faster than the whole head's (0.73 mm against 0.84, 1.68 against 2.16).
- ``simplex_adaptive``: the same with the parameters of Gao and Han 2012.
- ``cma``: CMA-ES with a diagonal covariance (Hansen's ``cma``); a full covariance in 60 dimensions needs more than
  3,500 evaluations before it helps.
- ``bobyqa``: Py-BOBYQA, quadratic models through 121 points, with at most 1,000 evaluations a level, since in 60
  dimensions its own algebra takes longer than these.
- ``soft``: a soft rasteriser with Adam (soft_rasteriser.py).
- ``contour_all`` and ``soft_all``: with every mode of the model instead of 60, which only solvers with derivatives can
  search. The database's subjects are then in the span, as the paper's were in its database.
- ``hull``: the visual hull. It has no vertices to compare, so its error is the distance of the true face to it.

The error is the mean over the face region's vertices, world frame, without realignment. Seconds are those of the search
from silhouettes to vertices, each solver warmed up, all on the same cores. Needs the dependency group ``peers``.
"""

# pyright: reportMissingImports=false
# The peers' packages are a dependency group of their own: `uv sync --group peers`.

import importlib.util
import os
import time
from collections.abc import Callable
from dataclasses import dataclass
from functools import partial
from typing import Any

import numpy as np
from jaxtyping import Float
from scipy.optimize import minimize

from pipeline.contour_fit.fit import Fit
from pipeline.geometry.surface_index import SurfaceIndex
from pipeline.head_model.model import HeadModel, with_modes
from pipeline.imaging.silhouette import Silhouette
from pipeline.settings import FittingSettings
from pipeline.simplex import xor_objective as objective
from pipeline.simplex.hierarchy import HIERARCHY, LIMIT, MU, TOLERANCE
from pipeline.simplex.xor_objective import SilhouetteObjective
from rig.errors import EigenheadError
from rig.render.renderer import Renderer
from rig.rig import Rig
from rig.studio.scene.layout import default_layout
from tests.laboratory.experiments import markdown
from tests.laboratory.experiments.peers import soft_rasteriser
from tests.laboratory.experiments.records import CONTOUR, Bench, Outcome, Row, key_of
from tests.laboratory.experiments.visual_hull import visual_hull
from tests.support.subjects import (
    Planted,
    binary_silhouettes,
    exact,
    fit_contour,
    mean_error_mm,
    subjects_of_section_5_2,
)

MODES = 60
CHECKED_EVERY = 10  # moves of scipy's simplex after which its spread is looked at
CMA_SIGMAS = (0.6, 0.3)  # first step of each level, in standard deviations
BOBYQA_LIMIT = 1000  # evaluations a level
BOBYQA_RADII = ((1.0, 0.05), (0.5, 0.02))  # first and last trust region of each level


@dataclass(frozen=True, slots=True, eq=False)
class Task:
    """Holds one subject, as every solver gets it."""

    whole: HeadModel
    model: HeadModel  # its first 60 modes, which every solver has
    subject: Planted
    silhouettes: dict[str, Silhouette]
    rig: Rig
    renderer: Renderer


class Counted:
    """Wraps a function and counts its calls and their seconds."""

    def __init__(self, function: Callable[[np.ndarray], float]) -> None:
        self._function = function
        self.calls, self.seconds = 0, 0.0

    def __call__(self, x: Float[np.ndarray, " m"]) -> float:
        """Returns the function's value at ``x``, and counts the call."""
        began = time.perf_counter()
        value = self._function(x)
        self.calls += 1
        self.seconds += time.perf_counter() - began
        return value


Minimiser = Callable[[Counted, Float[np.ndarray, " m"], int], Float[np.ndarray, " m"]]


class MissingPeers(EigenheadError):
    """Reports that a package of the group ``peers`` is not installed."""

    def __init__(self, package: str) -> None:
        super().__init__(f"{package} is not installed: run `uv sync --group peers`")


def peers(model: HeadModel, *, renderer: Renderer, bench: Bench, subjects: int = 10) -> Outcome:
    """Runs this module's experiment. Returns seconds, evaluations and errors of every solver on ``subjects`` of section
    5.2's hundred, taken at even steps. Raises MissingPeers."""
    for package in ("cma", "pybobyqa", "jax"):
        if importlib.util.find_spec(package) is None:
            raise MissingPeers(package)
    span, rig = with_modes(model, MODES), exact(default_layout())
    everyone = subjects_of_section_5_2(model, 100)
    chosen = [everyone[i] for i in np.linspace(0, len(everyone) - 1, subjects).round().astype(int)]
    records = {
        name: bench.records(f"peers-{name}", key_of(model.sha256, FittingSettings(), machine(renderer), *sources))
        for name, (_, sources) in SOLVERS.items()
    }
    warm: set[str] = set()
    rows = []
    for i, subject in enumerate(chosen):
        task = Task(model, span, subject, binary_silhouettes(model, subject, rig, renderer), rig, renderer)
        row: Row = {"name": subject.name, "mean_head_mm": mean_error_mm(model, mean_head(subject), subject)}
        for j, (name, (solve, _)) in enumerate(SOLVERS.items()):
            bench.report(f"{subject.name} {name}", (i + j / len(SOLVERS)) / len(chosen))
            row[name] = records[name].row(subject.name, lambda n=name, s=solve, t=task: timed(n, s, t, warm))
        rows.append(row)
    found = figures(rows)
    return {"figures": found, "rows": rows, "machine": machine(renderer), "markdown": as_markdown(found)}


def machine(renderer: Renderer) -> str:
    """Describes the machine and libraries on which seconds depend."""
    return f"{len(os.sched_getaffinity(0))} cores, {renderer.context.description}"


def mean_head(subject: Planted) -> Fit:
    """Returns the start of the other solvers: the mean head at the true pose."""
    return Fit("mean head", np.zeros(MODES), subject.world_from_head, 0, "")


def timed(name: str, solve: Callable[[Task], Row], task: Task, warm: set[str]) -> Row:
    """Runs a solver and returns its row with its seconds. Before the first run of a solver with compiled code, it is
    warmed up."""
    if name in WARMED and name not in warm:
        solve(task)
    warm.add(name)
    began = time.perf_counter()
    row = solve(task)
    return {"seconds": time.perf_counter() - began} | row


def derivative_free(minimise: Minimiser) -> Callable[[Task], Row]:
    """Returns a solver that runs ``minimise`` on values of eq. (5) alone, on the paper's two levels."""

    def solve(task: Task) -> Row:
        coefficients, calls, seconds = np.zeros(MODES), 0, 0.0
        pose = task.subject.world_from_head
        for number, level in enumerate(HIERARCHY):
            with SilhouetteObjective(
                task.model, pose, task.silhouettes, task.rig, renderer=task.renderer, level=level.mesh,
                scale=level.image_scale, start=coefficients,
            ) as cost:  # fmt: skip
                counted = Counted(cost)
                coefficients = minimise(counted, coefficients, number)
            calls, seconds = calls + counted.calls, seconds + counted.seconds
        fit = Fit("peer", coefficients, pose, calls, "")
        return error_row(task, fit) | {"ms_per_evaluation": 1000.0 * seconds / calls}

    return solve


def error_row(task: Task, fit: Fit) -> Row:
    """Returns the mean distance (mm) of the face region's vertices from their true positions, and the evaluations that
    the fit took."""
    return {"error_mm": mean_error_mm(task.whole, fit, task.subject), "evaluations": fit.evaluations}


def nelder_mead(function: Counted, start: Float[np.ndarray, " m"], *, adaptive: bool) -> Float[np.ndarray, " m"]:
    """Minimises a function by SciPy's downhill simplex, until the relative spread of its values is small. SciPy has no
    such rule: it is run for a few moves at a time, and goes on from its own simplex, whose values are remembered."""
    known: dict[bytes, float] = {}

    def remembered(x: Float[np.ndarray, " m"]) -> float:
        key = x.tobytes()
        if key not in known:
            known[key] = function(x)
        return known[key]

    simplex = np.vstack([start, start + MU * np.eye(len(start))])
    while True:
        options = {
            "initial_simplex": simplex, "adaptive": adaptive, "maxiter": CHECKED_EVERY, "maxfev": 10**9,
            "xatol": 0.0, "fatol": 0.0,
        }  # fmt: skip
        simplex, values = minimize(remembered, simplex[0], method="Nelder-Mead", options=options).final_simplex
        known = {point.tobytes(): value for point, value in zip(simplex, values, strict=True)}
        if 2.0 * (values[-1] - values[0]) < TOLERANCE * (values[-1] + values[0]) or function.calls >= LIMIT:
            return simplex[0]


def diagonal_cma(function: Counted, start: Float[np.ndarray, " m"], level: int) -> Float[np.ndarray, " m"]:
    """Minimises a function by CMA-ES with a diagonal covariance (the library cma), from the same seed each time."""
    import cma

    options = {"CMA_diagonal": True, "maxfevals": LIMIT, "seed": 1, "verbose": -9}
    search = cma.CMAEvolutionStrategy(start, CMA_SIGMAS[level], options)
    search.optimize(function)
    return np.asarray(search.result.xbest)


def bobyqa(function: Counted, start: Float[np.ndarray, " m"], level: int) -> Float[np.ndarray, " m"]:
    """Minimises a function by BOBYQA, Powell's trust region without derivatives (the library Py-BOBYQA)."""
    import pybobyqa

    first, last = BOBYQA_RADII[level]
    found = pybobyqa.solve(
        function, start, rhobeg=first, rhoend=last, maxfun=BOBYQA_LIMIT, objfun_has_noise=True, do_logging=False
    )
    return np.asarray(found.x)


def soft(task: Task, *, whole: bool = False) -> Row:
    """Fits the shape with a differentiable soft rasteriser. ``whole`` takes all modes of the model, else as many as the
    paper."""
    pose, model = task.subject.world_from_head, task.whole if whole else task.model
    coefficients, steps = soft_rasteriser.fit_soft(
        model, pose, task.silhouettes, task.rig, renderer=task.renderer, modes=len(model.modes)
    )
    return error_row(task, Fit("soft", coefficients, pose, steps, ""))


def hull(task: Task) -> Row:
    """Computes the visual hull, and returns the mean distance (mm) of the true face's vertices from it."""
    mesh = visual_hull(task.silhouettes, task.rig)
    face = task.subject.vertices(task.whole)[task.model.levels["full"].face_region]
    distances = SurfaceIndex(mesh.vertices, mesh.faces, 1.0).closest(face).distances
    return {"error_mm": float(distances.mean()), "evaluations": 1}


def ours(task: Task, *, whole: bool = False) -> Row:
    """Fits the shape with this project's contour solver. ``whole`` takes all modes of the model, else as many as the
    paper."""
    model = task.whole if whole else task.model
    fit = fit_contour(model, task.subject.start, task.silhouettes, task.rig, FittingSettings())
    return error_row(task, fit)


_FREE = (objective,)
SOLVERS: dict[str, tuple[Callable[[Task], Row], tuple[Any, ...]]] = {
    "contour": (ours, CONTOUR),
    "contour_all": (partial(ours, whole=True), CONTOUR),
    "hull": (hull, ()),
    "soft": (soft, (soft_rasteriser,)),
    "soft_all": (partial(soft, whole=True), (soft_rasteriser,)),
    "simplex": (derivative_free(lambda f, x, level: nelder_mead(f, x, adaptive=False)), _FREE),
    "simplex_adaptive": (derivative_free(lambda f, x, level: nelder_mead(f, x, adaptive=True)), _FREE),
    "cma": (derivative_free(diagonal_cma), _FREE),
    "bobyqa": (derivative_free(bobyqa), _FREE),
}
WARMED = ("contour", "contour_all", "hull", "soft", "soft_all")


def figures(rows: list[Row]) -> dict[str, float]:
    """Returns the means over the subjects, by solver, and each solver's ratios to the contour solver. These are ratios
    of sums, so that no subject counts more than its seconds."""
    found: dict[str, float] = {"subjects": len(rows)}
    found["mean_head_mm"] = float(np.mean([row["mean_head_mm"] for row in rows]))
    total = {name: {q: sum(row[name][q] for row in rows) for q in ("seconds", "error_mm")} for name in SOLVERS}
    for name in SOLVERS:
        for quantity in rows[0][name]:
            found[f"{name}_{quantity}"] = float(np.mean([row[name][quantity] for row in rows]))
        if name != "contour":
            found[f"speedup_over_{name}"] = total[name]["seconds"] / total["contour"]["seconds"]
            found[f"error_ratio_{name}"] = total[name]["error_mm"] / total["contour"]["error_mm"]
    return found


def as_markdown(found: dict[str, float]) -> str:
    """Returns the figures as a Markdown table with a row for each solver."""

    def row(name: str) -> list[markdown.Cell]:
        quantities = ("seconds", "evaluations", "ms_per_evaluation", "error_mm")
        ratios = (f"speedup_over_{name}", f"error_ratio_{name}")
        return [name, *(found.get(f"{name}_{q}") for q in quantities), *(found.get(r) for r in ratios)]

    header = ("solver", "seconds", "evaluations", "ms each", "error, mm", "times slower", "times the error")
    return markdown.table(header, [row(name) for name in SOLVERS])
