"""The contour solver's robust cost and its normal equations.

Residual of a rim sample: the input's signed distance ``r = D_obs(u)`` (px), with

    dr/dz      = n^T P s R B            n^T P from rim.py, B the modes at the sample
    dr/dpose   = n^T P [-[X - c]x, I, X - c]        rotation and log scale about the head's place c, translation
    dr/dcamera = n^T P_c [-[X_c]x, I]               left perturbation of camera_from_world

Each sample stands for ``length`` px of outline and weighs ``length / (l sigma^2)``: the Fisher information of a contour
with noise sigma and correlation length l. Priors: z ~ N(0, I), the calibration's covariance, a metric scale.

Clutter (hair, shoulders, clothes) only ever adds area: the input may lie outside the model, hardly ever inside. So the
robust scale (Geman-McClure) is one-sided: it forgives early where the model lies inside the input, and late where it
sticks out.
"""

from dataclasses import dataclass
from itertools import pairwise

import numpy as np
from jaxtyping import Float
from numba import njit

from pipeline.fitting.clutter import held_inside, without_clutter
from pipeline.fitting.problem import PER_CAMERA, POSE, Problem, Stage, State, moved_views
from pipeline.fitting.rim import Rim, find_rim, project_with_slopes
from pipeline.fitting.surface import surface_cost, surface_equations
from pipeline.fitting.threads import in_threads
from rig.geometry import Similarity, rotation_from_vector

OUTSIDE_SCALE = 2.0  # robust scale where the model sticks out of the input, by the other side's; 3 (10 px at least)
# left 20 % of bad contour ten times the error
FEATURE_SCALE = 4.0  # Geman-McClure scale of a feature point, in its standard deviations


@dataclass(frozen=True, slots=True, eq=False)
class Evaluation:
    """Cost and, on demand, its normal equations at a state."""

    cost: float
    rim: Rim


def evaluate(problem: Problem, state: State, stage: Stage, scale_px: float, reference: float | None) -> Evaluation:
    """The robust cost. ``reference``: outline length (px) that the rim's part is scaled to, so that a fit gains nothing
    by hiding its rim."""
    vertices = state.world_from_head.apply(problem.bases[stage.level].vertices(state.coefficients))
    topology = problem.topologies[stage.level]
    # On a decimated mesh a sample's share of the outline is long enough to be half clutter: it would hide what is not.
    fine, whole = stage.level == "full", stage.whole_head or stage.contained
    rim = find_rim(topology, vertices, moved_views(problem, state), whole_head=whole, averaged=fine)
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
    basis = problem.bases[stage.level]
    operator = basis.operator
    rows = np.empty((len(rim.view), stage.modes + POSE + PER_CAMERA))
    # One type for every level, or the loop is compiled once for each.
    start, member = operator.indptr.astype(np.int64), operator.indices.astype(np.int64)
    blend, point, gradient = (np.ascontiguousarray(part) for part in (rim.blend, rim.point, rim.gradient))
    turn = pose.scale * pose.rotation

    def fill(first: int, last: int) -> None:
        _fill_rows(
            first, last, start, member, operator.data, basis.modes, stage.modes, turn, pose.translation, views.rotation,
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
