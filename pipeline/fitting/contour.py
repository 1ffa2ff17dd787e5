"""The contour solver: Levenberg-Marquardt on the rim (section 4.4's problem, another cost and another minimiser).

In: the silhouettes' signed distances, a start pose, feature points where there are any. Out: coefficients, pose, camera
corrections, and their covariance. Residual of a rim sample: the input's signed distance ``r = D_obs(u)`` (px), with

    dr/dz      = n^T P s R B            n^T P from rim.py, B the modes at the sample
    dr/dpose   = n^T P [-[X - c]x, I, X - c]        rotation and log scale about the head's place c, translation
    dr/dcamera = n^T P_c [-[X_c]x, I]               left perturbation of camera_from_world

Each sample stands for ``length`` px of outline and weighs ``length / (l sigma^2)``: the Fisher information of a contour
with noise sigma and correlation length l. Priors: z ~ N(0, I), the calibration's covariance, a metric scale.

Clutter (hair, shoulders, clothes) only ever adds area: the input may lie outside the model, hardly ever inside. So the
robust scale (Geman-McClure) is one-sided: it forgives early where the model lies inside the input, and late where it
sticks out. It shrinks step by step, which carries the fit over clutter from a start that is 20 px off.
"""

from collections.abc import Callable, Mapping
from dataclasses import dataclass, field, replace
from itertools import pairwise

import cv2
import numpy as np
import scipy.linalg
import scipy.sparse as sparse
from jaxtyping import Bool, Float, Float32, Int
from numba import njit

from pipeline.eigenheads.model import HeadModel
from pipeline.fitting.fit import Fit
from pipeline.fitting.rim import Rim, Topology, Views, find_rim, make_topology, pack_views, project_with_slopes
from pipeline.fitting.surface import SurfaceObservations, surface_cost, surface_equations
from pipeline.fitting.threads import in_threads
from pipeline.settings import FittingSettings
from pipeline.silhouette import Silhouette
from rig.camera import Camera
from rig.geometry import Similarity, rotation_from_vector
from rig.layout import Rig

FIRST_NOISE_PX, FIRST_CORRELATION_PX = 1.0, 6.0  # before the residuals have been seen: a model that does not quite fit
BLOCK_PX = 20.0
BARE_SLACK_PX = 0.1  # noise of a contour's RMS
FLOOR_SIGMAS, FLOOR_MOST_PX = 3.0, 6.0
CLUTTER_PX, CLUTTER_SIGMAS = 3.0, 3.0  # the input lies outside the model by more: hair, ears, collar
OUTSIDE_SCALE = 2.0  # robust scale where the model sticks out of the input, by the other side's; 3 (10 px at least)
# left 20 % of bad contour ten times the error
OUTSIDE_SHARE = 0.3  # weight of a rim outside the face that sticks out: a model's neck is less sure than its face
CELL_PX, CLUTTER_CELLS = 4, 3  # clutter reaches 12 px beyond where it was found: its border slides with the fit
UNIT_RANGE = (1.0, 40.0)  # px^3: noise of 0.5 px over 4 px; misfit of 2 px over 10 px
TRIES = 3  # of a step, each with a hundred times the damping
NON_MONOTONE = 4  # costs that a step may climb back to
POSE = 7  # rotation, translation, log scale
PER_CAMERA = 6  # rotation, translation


@dataclass(frozen=True, slots=True, eq=False)
class State:
    """Where the solver stands."""

    coefficients: Float[np.ndarray, " m"]
    world_from_head: Similarity
    camera_shift: Float[np.ndarray, "k 6"]  # left perturbation of each camera_from_world


@dataclass(frozen=True, slots=True)
class Stage:
    """One level of the coarse-to-fine schedule."""

    level: str
    modes: int
    cameras: bool  # are the cameras solved for as well?
    scales_px: tuple[float, ...]  # robust scale, step by step
    whole_head: bool  # may rims outside the face region speak?
    contained: bool  # may they at least speak where they stick out of the input, as no hair explains?
    steps: int  # Levenberg-Marquardt steps at most, at each scale


@dataclass(frozen=True, slots=True, eq=False)
class Observed:
    """Feature points, packed: landmark vertex (row of the full level), view, pixel, and what the model says of the
    landmark (head frame, mm)."""

    vertex: Int[np.ndarray, " n"]
    view: Int[np.ndarray, " n"]
    pixel: Float[np.ndarray, "n 2"]
    mean: Float[np.ndarray, "n 3"]
    basis: Float32[np.ndarray, "m n 3"]


@dataclass(frozen=True, slots=True, eq=False)
class Problem:
    """Everything that stays fixed during a fit."""

    model: HeadModel
    rig: Rig
    views: Views
    bases: Mapping[str, tuple[sparse.csr_array, Float32[np.ndarray, "v 3 m"]]]  # by level: operator, modes by vertex
    topologies: Mapping[str, Topology]
    camera_information: Float[np.ndarray, "k 6 6"]  # inverse prior covariance
    features: Observed | None
    settings: FittingSettings
    unit: float  # l sigma^2 (px^3): what a px^2 of residual along a px of outline is divided by
    floor_px: float = 0.0  # no robust scale below this: three standard deviations of the model's misfit
    clutter: tuple[Bool[np.ndarray, "_ _"], ...] | None = None  # per view, in cells: where the input is hair or clothes
    surface: SurfaceObservations | None = None  # what photographs say between the rims
    hair: Mapping[str, Bool[np.ndarray, " v"]] = field(default_factory=dict)  # by level: whose outline is hair's


@dataclass(frozen=True, slots=True, eq=False)
class Evaluation:
    """Cost and, on demand, its normal equations at a state."""

    cost: float
    rim: Rim


@dataclass(frozen=True, slots=True, eq=False)
class Solved:
    """A problem with its solution, from which others may go on."""

    problem: Problem
    state: State
    stage: Stage  # the last one
    evaluations: int
    stopped_because: str
    misfit_mm: Float[np.ndarray, " v0"] | None = None  # of ``Fit``


def fit_contour(
    model: HeadModel,
    world_from_head: Similarity,
    silhouettes: Mapping[str, Silhouette],
    rig: Rig,
    settings: FittingSettings,
    *,
    features: Mapping[str, Mapping[str, np.ndarray]] | None = None,
    report: Callable[[str, float], None] = lambda stage, fraction: None,
) -> Fit:
    """Fits shape, pose and cameras to the silhouettes that are usable, from a start pose.

    All modes of ``model`` are used: the first ``settings.modes`` first, the rest once those have settled.
    """
    return finish(solve_contour(model, world_from_head, silhouettes, rig, settings, features=features, report=report))


def solve_contour(
    model: HeadModel,
    world_from_head: Similarity,
    silhouettes: Mapping[str, Silhouette],
    rig: Rig,
    settings: FittingSettings,
    *,
    features: Mapping[str, Mapping[str, np.ndarray]] | None = None,
    report: Callable[[str, float], None] = lambda stage, fraction: None,
) -> Solved:
    """``fit_contour`` without its covariance."""
    problem = make_problem(model, world_from_head, silhouettes, rig, settings, features or {})
    few, span, whole, *rest = schedule(settings, len(model.modes))
    state = start_state(problem, world_from_head)
    state, spent, reason = run_stage(problem, state, few, lambda f: report("fit", 0.2 * f))
    state, used, reason = run_stage(problem, state, span, lambda f: report("fit", 0.2 + 0.2 * f))
    tried, more, _ = run_stage(problem, state, whole, lambda f: report("fit", 0.4 + 0.1 * f))
    spent += used + more
    bare = is_bare(problem, tried, whole, state)
    if bare:
        state, span = tried, whole
    problem = with_misfit(problem, state, span)
    stage = span
    for i, stage in enumerate(rest):
        stage = replace(stage, whole_head=bare)
        state, used, reason = run_stage(
            problem, state, stage, lambda f, i=i: report("fit", 0.5 + 0.5 * (i + f) / len(rest))
        )
        spent += used
        problem = with_misfit(problem, state, stage)
    return Solved(problem, state, stage, spent, reason)


def schedule(settings: FittingSettings, modes: int) -> list[Stage]:
    """Pose and a few modes on a decimated mesh; the eigenheads, from the face's rim; the same from the whole head's,
    kept if the head turns out to be bare; then what modes the model has beyond the eigenheads; then the full mesh."""
    few, span = min(settings.modes_first, modes), min(settings.modes, modes)
    last = settings.robust_px
    wider = [Stage("p95", modes, True, (2.0 * last, last), False, True, 4)] if modes > span else []
    return [
        Stage("p95", few, False, (20.0, 12.0, 7.2, 4.3), False, False, 3),
        Stage("p95", span, True, (6.0, 4.0, last), False, True, 4),
        Stage("p95", span, True, (20.0, 10.0, 5.0, 2.0 * last), True, True, 4),
        *wider,
        Stage("full", modes, True, (last,), False, True, 8),
    ]


def with_misfit(problem: Problem, state: State, stage: Stage) -> Problem:
    """The problem with what the residuals say of the model's misfit: unit, robust floor and, once, where clutter is.

    Clutter is found while the eigenheads alone still hold the shape: a wider basis would rather bulge into the hair
    than pay for it as an outlier, since every px of outline pays alone.
    """
    rim = evaluate(problem, state, stage, stage.scales_px[-1], None).rim
    near = rim.residual[(np.abs(rim.residual) < 10.0) & (rim.length > 0)]
    deviation = 1.4826 * float(np.median(np.abs(near))) if len(near) > 10 else FIRST_NOISE_PX
    floor = min(FLOOR_SIGMAS * deviation, FLOOR_MOST_PX)
    clutter = problem.clutter
    if clutter is None and not stage.whole_head:  # a bare head has none
        clutter = find_clutter(problem, rim, max(CLUTTER_PX, CLUTTER_SIGMAS * deviation))
    return replace(problem, unit=estimated_unit(problem, rim, 2.0 * floor), floor_px=floor, clutter=clutter)


def held_inside(problem: Problem, rim: Rim, level: str) -> Rim:
    """The rim where cranium, ears and neck only count as far as they stick out of the input."""
    face = face_of(problem, level)[rim.corner].all(axis=1)
    share = np.where(rim.residual > 0, OUTSIDE_SHARE, 0.0)
    return replace(rim, length=np.where(face, rim.length, share * rim.length))


def face_of(problem: Problem, level: str) -> Bool[np.ndarray, " v"]:
    """The face region, less what is known to lie under hair."""
    region = problem.model.levels[level].face_region
    return region & ~problem.hair[level] if level in problem.hair else region


def find_clutter(problem: Problem, rim: Rim, threshold_px: float) -> tuple[Bool[np.ndarray, "_ _"], ...]:
    """Cells of every view where the input lies outside the model by more than the threshold, and around them."""
    maps = []
    for k, (width, height) in enumerate(problem.views.size):
        cells = np.zeros((height // CELL_PX + 1, width // CELL_PX + 1), np.uint8)
        strange = (rim.view == k) & (rim.residual < -threshold_px)
        at = (rim.pixel[strange] / CELL_PX).astype(int)
        cells[at[:, 1], at[:, 0]] = 1
        maps.append(cv2.dilate(cells, np.ones((2 * CLUTTER_CELLS + 1,) * 2, np.uint8)) > 0)
    return tuple(maps)


def without_clutter(problem: Problem, rim: Rim) -> Rim:
    """The rim with no weight where the input is clutter."""
    if problem.clutter is None:
        return rim
    cell = (rim.pixel / CELL_PX).astype(int)
    length = rim.length.copy()
    for k, cells in enumerate(problem.clutter):
        here = np.flatnonzero(rim.view == k)
        length[here[cells[cell[here, 1], cell[here, 0]]]] = 0.0
    return replace(rim, length=length)


def estimated_unit(problem: Problem, rim: Rim, most_px: float) -> float:
    """l sigma^2 (px^3) of what the contours still miss, the model's misfit included, unless the settings state both.

    Means over blocks of B px of outline have the variance l sigma^2 / B where B is well above l, whatever l is.
    """
    stated = problem.settings
    if stated.contour_noise_px is not None and stated.contour_correlation_px is not None:
        return problem.unit
    means = []
    for k in range(len(problem.views.names)):
        here = np.flatnonzero((rim.view == k) & (np.abs(rim.residual) < most_px) & (rim.length > 0))
        if not len(here):
            continue
        spoke = rim.pixel[here] - rim.pixel[here].mean(axis=0)
        order = here[np.argsort(np.arctan2(spoke[:, 1], spoke[:, 0]))]
        length = rim.length[order]
        block = (np.cumsum(length) / BLOCK_PX).astype(int)
        total = np.bincount(block, length)
        means.append((np.bincount(block, length * rim.residual[order]) / np.maximum(total, 1e-9))[total > BLOCK_PX / 2])
    found = np.concatenate(means) if means else np.zeros(0)
    variance = (1.4826 * float(np.median(np.abs(found)))) ** 2 if len(found) > 10 else FIRST_NOISE_PX**2
    return float(np.clip(BLOCK_PX * variance, *UNIT_RANGE))


def is_bare(problem: Problem, state: State, stage: Stage, from_face: State) -> bool:
    """Does a fit to the whole head explain cranium and ears, and the face as well as ``from_face``, the fit to the face
    alone? An outline of hair is mostly no head's; where it is, that head has another face."""
    rim = evaluate(problem, state, replace(stage, whole_head=True), stage.scales_px[-1], None).rim
    region = problem.model.levels[stage.level].face_region
    other = np.flatnonzero(~region[rim.corner].all(axis=1))
    face = np.flatnonzero(region[rim.corner].all(axis=1))
    agrees = np.abs(rim.residual) < problem.settings.bare_px
    if (rim.length * agrees)[other].sum() <= problem.settings.bare_share * rim.length[other].sum():
        return False
    alone = evaluate(problem, from_face, replace(stage, whole_head=False), stage.scales_px[-1], None).rim
    face_alone = np.flatnonzero(region[alone.corner].all(axis=1))
    return _spread(rim, face) < problem.settings.bare_loss * _spread(alone, face_alone) + BARE_SLACK_PX


def _spread(rim: Rim, chosen: Int[np.ndarray, " s"]) -> float:
    """Robust standard deviation (px) of the residuals: hair on the forehead must not hide what the rest loses."""
    return 1.4826 * float(np.median(np.abs(rim.residual[chosen]))) if len(chosen) else 0.0


def make_problem(
    model: HeadModel,
    world_from_head: Similarity,
    silhouettes: Mapping[str, Silhouette],
    rig: Rig,
    settings: FittingSettings,
    features: Mapping[str, Mapping[str, np.ndarray]],
    levels: tuple[str, ...] = ("p95", "full"),
) -> Problem:
    """Packs what stays fixed. Raises ValueError if no silhouette is usable."""
    usable = {name: s.distance for name, s in silhouettes.items() if s.quality.usable and name in rig}
    views = pack_views(rig, usable)
    rig = rig.subset(views.names)
    topologies = {name: level_topology(model, name) for name in levels}
    depths = [camera.camera_from_world.apply(world_from_head.translation)[2] for camera in rig]
    information = [camera_information(c, z, settings.calibration_px) for c, z in zip(rig, depths, strict=True)]
    return Problem(
        model=model,
        rig=rig,
        views=views,
        bases={name: level_basis(model, name) for name in levels},
        topologies=topologies,
        camera_information=np.stack(information),
        features=pack_features(model, views.names, features),
        settings=settings,
        unit=(settings.contour_noise_px or FIRST_NOISE_PX) ** 2
        * (settings.contour_correlation_px or FIRST_CORRELATION_PX),
    )


def level_basis(model: HeadModel, name: str) -> tuple[sparse.csr_array, Float32[np.ndarray, "v 3 m"]]:
    """Modes contiguous by vertex, and what takes them to the level: for a decimated level its own rows (2 MB), for the
    full one the cage's, through the level's operator (the full level's own rows would be 40 to 170 MB)."""
    level = model.levels[name]
    if level.count < len(model.mean):
        own = model.basis(name, len(model.modes)).transpose(1, 2, 0)
        return sparse.csr_array(sparse.identity(level.count, format="csr")), np.ascontiguousarray(own)
    return level.operator, np.ascontiguousarray(model.modes.transpose(1, 2, 0))


def level_topology(model: HeadModel, name: str) -> Topology:
    """A level's edges and regions. The neck below the chin never speaks: heads turn on it, collars hide it, and its cut
    is no contour of anybody."""
    level = model.levels[name]
    mean = model.vertices(np.zeros(0), name)
    chin = model.vertices(np.zeros(0))[model.landmarks["gnathion"], 1]
    return make_topology(level.faces, level.face_region, mean[:, 1] > chin)


def camera_information(camera: Camera, depth_mm: float, error_px: float) -> Float[np.ndarray, "6 6"]:
    """Inverse prior covariance of a camera's correction: its calibration's own, or ``error_px`` in the image.

    A correction of the default prior moves a head of 100 mm radius at ``depth_mm`` by ``error_px`` RMS, half of it (in
    variance) by rotation and half by translation, which a head cannot tell apart.
    """
    if camera.covariance is not None:
        return np.linalg.inv(camera.covariance + 1e-12 * np.eye(6))
    focal, radius = camera.intrinsics.fx, 100.0
    shift = error_px / np.sqrt(2.0)
    tilt, roll = shift / focal, error_px * depth_mm / (focal * radius)
    slide, range_mm = shift * depth_mm / focal, error_px * depth_mm**2 / (focal * radius)
    return np.diag(1.0 / np.array([tilt, tilt, roll, slide, slide, range_mm]) ** 2)


def pack_features(
    model: HeadModel, names: tuple[str, ...], features: Mapping[str, Mapping[str, np.ndarray]]
) -> Observed | None:
    found = [
        (model.landmarks[landmark], names.index(camera), pixel)
        for landmark, views in sorted(features.items())
        if landmark in model.landmarks
        for camera, pixel in sorted(views.items())
        if camera in names
    ]
    if not found:
        return None
    vertex, view, pixel = (np.array(column) for column in zip(*found, strict=True))
    return Observed(vertex, view, pixel.astype(float), *landmark_basis(model, vertex))


def landmark_basis(
    model: HeadModel, vertex: Int[np.ndarray, " n"]
) -> tuple[Float[np.ndarray, "n 3"], Float32[np.ndarray, "m n 3"]]:
    """Mean and all modes at vertices of the full level."""
    mean = np.asarray(model.levels["full"].operator[vertex] @ model.mean, float)
    return mean, model.basis("full", len(model.modes), vertex)


def widened(problem: Problem, model: HeadModel, levels: tuple[str, ...]) -> Problem:
    """The same problem with a model of the same mesh that has more modes, solved on ``levels``."""
    features = problem.features
    if features is not None:
        mean, basis = landmark_basis(model, features.vertex)
        features = replace(features, mean=mean, basis=basis)
    bases = {name: level_basis(model, name) for name in levels}
    return replace(problem, model=model, bases=bases, features=features)


def start_state(problem: Problem, world_from_head: Similarity) -> State:
    return State(np.zeros(0), world_from_head, np.zeros((len(problem.views.names), PER_CAMERA)))


def run_stage(problem: Problem, state: State, stage: Stage, report: Callable[[float], None]) -> tuple[State, int, str]:
    """Levenberg-Marquardt through the robust scales of one stage: state, evaluations, why it stopped."""
    few = state.coefficients[: stage.modes]
    state = replace(state, coefficients=np.concatenate([few, np.zeros(stage.modes - len(few))]))
    evaluations, reason = 0, "step limit"
    for i, scale in enumerate(stage.scales_px):
        report(i / len(stage.scales_px))
        coarse = scale > problem.settings.robust_px
        unit = max(problem.unit, coarse_unit(scale)) if coarse else problem.unit
        state, used, reason = _descend(replace(problem, unit=unit), state, stage, max(scale, problem.floor_px))
        evaluations += used
    return state, evaluations, reason


def _descend(problem: Problem, state: State, stage: Stage, scale_px: float) -> tuple[State, int, str]:
    """Levenberg-Marquardt at one robust scale.

    The set of rim samples changes with the state, which makes the cost slightly uneven: strict descent was seen to stop
    at ridges 0.3 mm from the minimum. So a step may climb back to the worst of the last costs (Grippo, Lampariello and
    Lucidi 1986), and the best state is returned.
    """
    damping = 1e-3
    now = best = evaluate(problem, state, stage, scale_px, None)
    best_state = state
    evaluations, recent = 1, [now.cost]
    reference = float(now.rim.length.sum())
    for _ in range(stage.steps):
        matrix, gradient = normal_equations(problem, state, now.rim, stage, scale_px)
        for _ in range(TRIES):
            damped = matrix + damping * np.diag(np.diag(matrix))
            step = -scipy.linalg.solve(damped, gradient, assume_a="pos", check_finite=False)
            moved = apply_step(state, step, stage)
            then = evaluate(problem, moved, stage, scale_px, reference)
            evaluations += 1
            if then.cost < max(recent[-NON_MONOTONE:]):
                break
            damping = max(damping * 100.0, 1e-2)
        else:
            return best_state, evaluations, "no step lowers the cost"
        state, now, damping = moved, then, max(damping * 0.1, 1e-7)
        recent.append(now.cost)
        if now.cost < best.cost:
            best, best_state = now, state
        if -float(gradient @ step) < problem.settings.tolerance:  # predicted fall: the step is short in its own sigma
            return best_state, evaluations, "converged"
    return best_state, evaluations, "step limit"


def moved_views(problem: Problem, state: State) -> Views:
    """The views with the cameras where the state has them."""
    if not state.camera_shift.any():
        return problem.views
    turn = rotation_from_vector(state.camera_shift[:, :3])
    rotation = turn @ problem.views.rotation
    translation = (turn @ problem.views.translation[:, :, None])[:, :, 0] + state.camera_shift[:, 3:]
    return replace(problem.views, rotation=rotation, translation=translation)


def evaluate(problem: Problem, state: State, stage: Stage, scale_px: float, reference: float | None) -> Evaluation:
    """The robust cost. ``reference``: outline length (px) that the rim's part is scaled to, so that a fit gains nothing
    by hiding its rim."""
    vertices = state.world_from_head.apply(problem.model.vertices(state.coefficients, stage.level))
    topology = problem.topologies[stage.level]
    rim = find_rim(topology, vertices, moved_views(problem, state), whole_head=stage.whole_head or stage.contained)
    rim = without_clutter(problem, rim)
    if stage.contained and not stage.whole_head:
        rim = held_inside(problem, rim, stage.level)
    rho = rim.residual**2 * _forgiveness(rim.residual, scale_px)
    total = float(rim.length.sum())
    outline = float((rim.length * rho).sum()) / problem.unit * ((reference or total) / max(total, 1.0))
    shift = state.camera_shift
    priors = float(state.coefficients @ state.coefficients)
    priors += float(np.einsum("ki,kij,kj->", shift, problem.camera_information, shift))
    priors += (np.log(state.world_from_head.scale) / problem.settings.scale_spread) ** 2
    if problem.surface is not None:
        priors += surface_cost(problem.surface, state.coefficients, state.world_from_head, shift)
    return Evaluation(outline + priors + _feature_cost(problem, state, scale_px), rim)


def coarse_unit(scale_px: float) -> float:
    """l sigma^2 (px^3) while residuals of that scale are let in: half of it counts as noise, so that the prior holds
    the shape. Without it hair over both ears pulled the first 15 modes to 8 standard deviations, and a head 5 mm."""
    return FIRST_CORRELATION_PX * (0.5 * scale_px) ** 2


def _forgiveness(residual: Float[np.ndarray, " s"], scale_px: float) -> Float[np.ndarray, " s"]:
    """Geman-McClure's rho / r^2, with another scale for each side."""
    side = np.where(residual < 0, scale_px, OUTSIDE_SCALE * scale_px)
    return 1.0 / (1.0 + (residual / side) ** 2)


def normal_equations(
    problem: Problem, state: State, rim: Rim, stage: Stage, scale_px: float
) -> tuple[Float[np.ndarray, "p p"], Float[np.ndarray, " p"]]:
    """J^T W J and J^T W r over (coefficients, pose, cameras), priors included."""
    rim = speaking(rim)
    rows = rim_rows(problem, state, rim, stage)
    weight = rim.length / problem.unit * _forgiveness(rim.residual, scale_px) ** 2
    shared, m = stage.modes + POSE, stage.modes
    size = shared + (PER_CAMERA * len(problem.views.names) if stage.cameras else 0)
    matrix, gradient = np.zeros((size, size)), np.zeros(size)
    ends = np.searchsorted(rim.view, np.arange(len(problem.views.names) + 1))
    for k, (first, last) in enumerate(pairwise(ends)):
        part = rows[first:last]
        weighted = part * weight[first:last, None]
        square, slope = weighted.T @ part, weighted.T @ rim.residual[first:last]
        matrix[:shared, :shared] += square[:shared, :shared]
        gradient[:shared] += slope[:shared]
        if stage.cameras:
            own = slice(shared + PER_CAMERA * k, shared + PER_CAMERA * (k + 1))
            matrix[:shared, own] = square[:shared, shared:]
            matrix[own, :shared] = square[shared:, :shared]
            matrix[own, own] = square[shared:, shared:]
            gradient[own] = slope[shared:]
    if problem.features is not None:
        rows, miss, weight = feature_rows(problem, state, stage, scale_px)
        matrix += (rows * weight[:, None]).T @ rows
        gradient += (rows * weight[:, None]).T @ miss
    if problem.surface is not None:
        more, slope = surface_equations(
            problem.surface, state.coefficients, state.world_from_head, state.camera_shift, cameras=stage.cameras
        )
        matrix += more
        gradient += slope
    matrix[np.arange(m), np.arange(m)] += 1.0
    gradient[:m] += state.coefficients
    spread = problem.settings.scale_spread
    matrix[m + 6, m + 6] += 1.0 / spread**2
    gradient[m + 6] += np.log(state.world_from_head.scale) / spread**2
    if stage.cameras:
        for k, information in enumerate(problem.camera_information):
            block = slice(m + POSE + PER_CAMERA * k, m + POSE + PER_CAMERA * (k + 1))
            matrix[block, block] += information
            gradient[block] += information @ state.camera_shift[k]
    return matrix, gradient


def speaking(rim: Rim) -> Rim:
    """The samples that have any weight."""
    kept = rim.length > 0
    return rim if kept.all() else Rim(*(getattr(rim, name)[kept] for name in Rim.__dataclass_fields__))


def rim_rows(problem: Problem, state: State, rim: Rim, stage: Stage) -> Float[np.ndarray, "s q"]:
    """d(residual) / d(coefficients, pose, the correction of the sample's own camera)."""
    pose, views = state.world_from_head, moved_views(problem, state)
    operator, modes = problem.bases[stage.level]
    rows = np.empty((len(rim.view), stage.modes + POSE + PER_CAMERA))
    # One type for every level, or the loop is compiled once for each.
    start, member = operator.indptr.astype(np.int64), operator.indices.astype(np.int64)
    blend, point, gradient = (np.ascontiguousarray(part) for part in (rim.blend, rim.point, rim.gradient))
    turn = pose.scale * pose.rotation

    def fill(first: int, last: int) -> None:
        _fill_rows(
            first, last, start, member, operator.data, modes, stage.modes, turn, pose.translation, views.rotation,
            views.translation, rim.view, rim.corner, blend, point, gradient, rows,
        )  # fmt: skip

    in_threads(len(rows), fill)
    return rows


@njit(cache=True, nogil=True, fastmath=True)
def _fill_rows(first, last, indptr, indices, data, modes, count, turn, place, rotation, translation, view, corner,
               blend, point, gradient, out):  # fmt: skip
    """Modes: the sum over the cage of (gradient . mode), through the level's operator and the edge's blend."""
    for s in range(first, last):
        gx, gy, gz = gradient[s]
        hx = gx * turn[0, 0] + gy * turn[1, 0] + gz * turn[2, 0]
        hy = gx * turn[0, 1] + gy * turn[1, 1] + gz * turn[2, 1]
        hz = gx * turn[0, 2] + gy * turn[1, 2] + gz * turn[2, 2]
        row = np.zeros(count, np.float32)
        for end in range(2):
            share = blend[s] if end else 1.0 - blend[s]
            v = corner[s, end]
            for j in range(indptr[v], indptr[v + 1]):
                i, w = indices[j], share * data[j]
                wx, wy, wz = np.float32(w * hx), np.float32(w * hy), np.float32(w * hz)
                for m in range(count):
                    row[m] += wx * modes[i, 0, m] + wy * modes[i, 1, m] + wz * modes[i, 2, m]
        for m in range(count):
            out[s, m] = row[m]
        _fill_rigid(point[s, 0] - place[0], point[s, 1] - place[1], point[s, 2] - place[2], gx, gy, gz, out[s], count)
        out[s, count + 6] = (
            gx * (point[s, 0] - place[0]) + gy * (point[s, 1] - place[1]) + gz * (point[s, 2] - place[2])
        )
        r, t = rotation[view[s]], translation[view[s]]
        _fill_rigid(
            r[0, 0] * point[s, 0] + r[0, 1] * point[s, 1] + r[0, 2] * point[s, 2] + t[0],
            r[1, 0] * point[s, 0] + r[1, 1] * point[s, 1] + r[1, 2] * point[s, 2] + t[1],
            r[2, 0] * point[s, 0] + r[2, 1] * point[s, 1] + r[2, 2] * point[s, 2] + t[2],
            r[0, 0] * gx + r[0, 1] * gy + r[0, 2] * gz,
            r[1, 0] * gx + r[1, 1] * gy + r[1, 2] * gz,
            r[2, 0] * gx + r[2, 1] * gy + r[2, 2] * gz,
            out[s], count + POSE,
        )  # fmt: skip


@njit(cache=True, fastmath=True)
def _fill_rigid(x, y, z, gx, gy, gz, out, first):
    """Rotation and translation: g . (w x arm) = w . (arm x g), and g."""
    out[first], out[first + 1], out[first + 2] = y * gz - z * gy, z * gx - x * gz, x * gy - y * gx
    out[first + 3], out[first + 4], out[first + 5] = gx, gy, gz


def _pose_rows(arm: Float[np.ndarray, "s 3"], gradient: Float[np.ndarray, "s 3"]) -> Float[np.ndarray, "s 7"]:
    turn = np.cross(arm, gradient)  # g . (w x arm) = w . (arm x g)
    return np.concatenate([turn, gradient, (arm * gradient).sum(axis=1, keepdims=True)], axis=1)


def feature_rows(
    problem: Problem, state: State, stage: Stage, scale_px: float
) -> tuple[Float[np.ndarray, "n p"], Float[np.ndarray, " n"], Float[np.ndarray, " n"]]:
    """Jacobian, residual (px) and weight of the feature points' two pixel coordinates."""
    observed = problem.features
    assert observed is not None
    points, misses, slopes = _project_features(problem, state)
    pose = state.world_from_head
    along = np.einsum("nad,mnd->nam", pose.scale * slopes @ pose.rotation, observed.basis[: stage.modes], optimize=True)
    arm = points - pose.translation
    cameras = PER_CAMERA * len(problem.views.names) if stage.cameras else 0
    rows = np.zeros((len(misses), 2, stage.modes + POSE + cameras))
    rows[:, :, : stage.modes] = along
    views = moved_views(problem, state)
    for axis in range(2):
        rows[:, axis, stage.modes : stage.modes + POSE] = _pose_rows(arm, slopes[:, axis])
        if stage.cameras:
            gradient = np.einsum("nij,nj->ni", views.rotation[observed.view], slopes[:, axis])
            point = np.einsum("nij,nj->ni", views.rotation[observed.view], points) + views.translation[observed.view]
            own = stage.modes + POSE + PER_CAMERA * observed.view[:, None] + np.arange(PER_CAMERA)
            rows[np.arange(len(points))[:, None], axis, own] = _pose_rows(point, gradient)[:, :PER_CAMERA]
    deviation = _feature_deviation(problem, slopes)
    forgiving = 1.0 / (1.0 + (misses**2).sum(axis=1) / (FEATURE_SCALE * deviation) ** 2) ** 2
    weight = np.repeat(forgiving / deviation**2, 2)
    return rows.reshape(len(weight), -1), misses.ravel(), weight


FEATURE_SCALE = 4.0  # Geman-McClure scale of a feature point, in its standard deviations


def _feature_deviation(problem: Problem, slopes: Float[np.ndarray, "n 2 3"]) -> Float[np.ndarray, " n"]:
    """A click's noise, and the landmark's place on another head, in pixels."""
    pixels_per_mm = np.linalg.norm(slopes, axis=(1, 2)) / np.sqrt(2.0)
    return np.hypot(problem.settings.feature_noise_px, problem.settings.landmark_noise_mm * pixels_per_mm)


def _feature_cost(problem: Problem, state: State, scale_px: float) -> float:
    if problem.features is None:
        return 0.0
    _, misses, slopes = _project_features(problem, state)
    square = (misses**2).sum(axis=1) / _feature_deviation(problem, slopes) ** 2
    return float((square / (1.0 + square / FEATURE_SCALE**2)).sum())


def _project_features(problem: Problem, state: State) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """World points, pixel misses, and d(pixel)/d(world point) of the observed landmarks."""
    observed = problem.features
    assert observed is not None
    moved = np.einsum("m,mnc->nc", state.coefficients, observed.basis[: len(state.coefficients)])
    points = state.world_from_head.apply(observed.mean + moved)
    views = moved_views(problem, state)
    pixels, slopes = project_with_slopes(points, observed.view, views)
    return points, pixels - observed.pixel, slopes


def apply_step(state: State, step: Float[np.ndarray, " p"], stage: Stage) -> State:
    m = stage.modes
    pose = state.world_from_head
    turned = rotation_from_vector(step[m : m + 3]) @ pose.rotation
    shift = state.camera_shift
    if stage.cameras:
        shift = shift + step[m + POSE :].reshape(shift.shape)
    moved = Similarity(pose.scale * float(np.exp(step[m + 6])), turned, pose.translation + step[m + 3 : m + 6])
    return State(state.coefficients + step[:m], moved, shift)


def finish(solved: Solved) -> Fit:
    """The fit with its Laplace covariance: the inverse of the last normal matrix, cameras marginalised."""
    problem, state, stage = solved.problem, solved.state, solved.stage
    scale = max(stage.scales_px[-1], problem.floor_px)
    rim = evaluate(problem, state, stage, scale, None).rim
    matrix, _ = normal_equations(problem, state, rim, stage, scale)
    kept = stage.modes + POSE
    covariance = np.linalg.inv(matrix)[:kept, :kept]
    names = problem.views.names
    return Fit(
        method="contour",
        coefficients=state.coefficients,
        world_from_head=state.world_from_head,
        evaluations=solved.evaluations,
        stopped_because=solved.stopped_because,
        covariance=covariance,
        misfit_mm=solved.misfit_mm,
        used={name: bool((rim.view == k).any()) for k, name in enumerate(names)},
        camera_shift=dict(zip(names, state.camera_shift, strict=True)),
    )
