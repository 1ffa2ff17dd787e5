"""One robust bundle adjustment over everything: intrinsics with distortion, camera poses, board poses.

Own Levenberg-Marquardt on the normal equations. A view (one camera, one shot) touches 15 camera and 6 board
parameters, so the equations are assembled from 21 x 21 blocks, one a view; with eleven cameras and thirty shots they
have 339 unknowns, which a dense Cholesky factor solves in ten milliseconds: sparse machinery would only cost
(docs/calibration.md has the times beside scipy's and Ceres's). Poses are perturbed from the left, as
``Camera.covariance`` states them.

Cost: ``sum rho(|r|^2 / sigma_c^2) + priors``, rho Cauchy's while outliers are sought and Huber's at the end, sigma_c
each camera's own noise. The priors on the intrinsics are weak; they only keep what the views do not determine where
lenses are.
"""

from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace

import numpy as np
from jaxtyping import Bool, Float, Int

from calibration import dense
from calibration.board import Board
from calibration.detection import View
from rig.camera import Camera, Distortion, Intrinsics
from rig.geometry import RigidTransform, nearest_rotation, rotation_from_vector

INTRINSICS = ("fx", "fy", "cx", "cy", "k1", "k2", "p1", "p2", "k3")
PER_CAMERA, PER_SHOT = len(INTRINSICS) + 6, 6
# Standard deviations of the priors. Lenses of 15 to 85 mm full-frame equivalent span a factor 2 to either side of 1.2
# image widths; sensors have square pixels to a percent; optical axes pass near the middle.
FOCAL_PRIOR, ASPECT_PRIOR, CENTRE_PRIOR = 0.7, 0.01, 0.05
LENS_PRIOR = {"k1": 0.5, "k2": 0.5, "p1": 0.01, "p2": 0.01, "k3": 0.5}
TOLERANCE = 1e-8  # relative gain of the cost below which the solution stands
HUBER = 2.0  # in sigma: 95 % of a Gaussian's 2D residuals are left as they are


@dataclass(frozen=True, slots=True, eq=False)
class Observations:
    """Corners of all views, sorted by view: ``camera``, ``shot`` index the state, ``starts`` the views."""

    camera: Int[np.ndarray, " v"]
    shot: Int[np.ndarray, " v"]
    starts: Int[np.ndarray, " v+1"]
    points: Float[np.ndarray, "n 3"]  # board frame, mm
    pixels: Float[np.ndarray, "n 2"]

    @property
    def view_of(self) -> Int[np.ndarray, " n"]:
        return np.repeat(np.arange(len(self.camera)), np.diff(self.starts))

    def subset(self, kept: Bool[np.ndarray, " n"]) -> "Observations":
        """Only the corners ``kept``; views stay, possibly empty."""
        counts = np.bincount(self.view_of[kept], minlength=len(self.camera))
        starts = np.concatenate([[0], np.cumsum(counts)])
        return replace(self, starts=starts, points=self.points[kept], pixels=self.pixels[kept])


@dataclass(frozen=True, slots=True, eq=False)
class State:
    """What is estimated. ``offsets``: time offset of each camera, in shots, along ``velocities`` of the board."""

    intrinsics: Float[np.ndarray, "c 9"]
    camera_rotations: Float[np.ndarray, "c 3 3"]
    camera_translations: Float[np.ndarray, "c 3"]
    board_rotations: Float[np.ndarray, "s 3 3"]
    board_translations: Float[np.ndarray, "s 3"]
    offsets: Float[np.ndarray, " c"]
    velocities: Float[np.ndarray, "s 6"]

    def camera_pose(self, index: int) -> RigidTransform:
        return RigidTransform(self.camera_rotations[index], self.camera_translations[index])


@dataclass(frozen=True, slots=True, eq=False)
class Prior:
    """Gaussian knowledge of the intrinsics: mean and information (inverse covariance) per camera."""

    mean: Float[np.ndarray, "c 9"]
    information: Float[np.ndarray, "c 9 9"]

    def and_also(self, mean: Float[np.ndarray, "c 9"], information: Float[np.ndarray, "c 9 9"]) -> "Prior":
        """Two independent pieces of knowledge joined."""
        total = self.information + information
        pull = np.einsum("cij,cj->ci", self.information, self.mean) + np.einsum("cij,cj->ci", information, mean)
        return Prior(np.linalg.solve(total, pull[:, :, None])[:, :, 0], total)


@dataclass(frozen=True, slots=True)
class Free:
    """Which parameters move. The first camera's pose never does: it fixes the world."""

    intrinsics: bool = True
    poses: bool = True
    boards: bool = True
    offsets: bool = False


@dataclass(frozen=True, slots=True, eq=False)
class Solution:
    """Where the adjustment ended."""

    state: State
    normal: Float[np.ndarray, "p p"]  # of the free parameters, at the solution, residuals in sigmas
    free: Bool[np.ndarray, " q"]
    cost: float
    iterations: int

    def covariance(self) -> Float[np.ndarray, "q q"]:
        """Of all parameters, cameras (intrinsics, pose) first, then boards, then offsets; zero for what was fixed."""
        full = np.zeros((len(self.free), len(self.free)))
        # Scaled to a unit diagonal first: parameters span from 1e-4 (distortion) to 1e3 (mm).
        scale = 1.0 / np.sqrt(np.maximum(np.diag(self.normal), 1e-12))
        scaled, eye = self.normal * np.outer(scale, scale), np.eye(len(scale))
        try:
            lower = dense.factor(scaled)
        except dense.NotPositiveDefinite:
            lower = dense.factor(scaled + 1e-9 * eye)  # what is not determined gets a variance beyond any use
        inverse = dense.solve(lower, eye) * np.outer(scale, scale)
        full[np.ix_(self.free, self.free)] = 0.5 * (inverse + inverse.T)
        return full


def observations(views: Sequence[View], cameras: Sequence[str], shots: Sequence[str], board: Board) -> Observations:
    corners = board.corners()
    counts = [len(view.found.ids) for view in views]
    return Observations(
        np.array([cameras.index(view.camera) for view in views], dtype=int),
        np.array([shots.index(view.shot) for view in views], dtype=int),
        np.concatenate([[0], np.cumsum(counts)]).astype(int),
        np.concatenate([corners[view.found.ids] for view in views]),
        np.concatenate([view.found.corners for view in views]),
    )


def weak_prior(sizes: Sequence[tuple[int, int]]) -> Prior:
    """What is known of any lens before a board is seen."""
    mean, sigma = [], []
    for width, height in sizes:
        long = max(width, height)
        mean.append([1.2 * long, 1.2 * long, (width - 1) / 2, (height - 1) / 2, 0, 0, 0, 0, 0])
        spread = [FOCAL_PRIOR * 1.2 * long] * 2 + [CENTRE_PRIOR * width, CENTRE_PRIOR * height]
        sigma.append(spread + [LENS_PRIOR[name] for name in INTRINSICS[4:]])
    information = np.stack([np.diag(np.array(row, dtype=float) ** -2) for row in sigma])
    return Prior(np.array(mean, dtype=float), information)


def held_at(intrinsics: Float[np.ndarray, "c 9"]) -> Prior:
    """For lenses that do not move: ``Free(intrinsics=False)``."""
    return Prior(intrinsics, np.zeros((len(intrinsics), 9, 9)))


def intrinsics_of(values: Float[np.ndarray, " 9"], size: tuple[int, int]) -> Intrinsics:
    fx, fy, cx, cy, *lens = (float(value) for value in values)
    return Intrinsics(*size, fx, fy, cx, cy, Distortion(*lens))


def values_of(intrinsics: Intrinsics) -> Float[np.ndarray, " 9"]:
    k = intrinsics
    return np.array([k.fx, k.fy, k.cx, k.cy, *k.distortion.opencv()])


def camera_of(state: State, index: int, name: str, size: tuple[int, int]) -> Camera:
    return Camera(name, intrinsics_of(state.intrinsics[index], size), state.camera_pose(index))


def residuals(state: State, seen: Observations) -> Float[np.ndarray, "n 2"]:
    """Projected less detected, pixels; 1e3 px where a corner falls behind its camera."""
    return _project(state, seen)[0] - seen.pixels


def corner_sigma(
    state: State, seen: Observations, lens_noise: Float[np.ndarray, " c"]
) -> tuple[Float[np.ndarray, " c"], float]:
    """Noise (px) of each camera's corners within the rig, and the part of it that all share.

    A camera's own noise is known from its lens. What the joint fit leaves beyond it comes from moments that differ or a
    board that bends: one variance for all cameras, for if each camera had its own, the fit could call one of them bad
    and follow the others exactly."""
    squares = (residuals(state, seen) ** 2).sum(axis=1)
    typical = float(np.median(squares)) / 1.1774**2
    shared = max(0.0, typical - float(np.median(lens_noise[seen.camera[seen.view_of]] ** 2)))
    return np.sqrt(lens_noise**2 + shared), float(np.sqrt(shared))


def robust_weights(squares: Float[np.ndarray, " n"], kind: str) -> Float[np.ndarray, " n"]:
    """Weights of iteratively reweighted least squares; ``squares`` are |r|^2 / sigma^2."""
    if kind == "none":
        return np.ones_like(squares)
    if kind == "cauchy":
        return 1.0 / (1.0 + squares / 4.0)
    return np.minimum(1.0, HUBER / np.sqrt(np.maximum(squares, 1e-12)))


def solve(
    state: State,
    seen: Observations,
    prior: Prior,
    sigma: Float[np.ndarray, " c"],
    *,
    free: Free | None = None,
    robust: str = "none",
    iterations: int = 60,
    tick: Callable[[], None] | None = None,
) -> Solution:
    """Minimises the cost from ``state``. ``sigma`` (px) is each camera's noise; ``tick`` is called every iteration."""
    mask = _free_mask(state, free or Free())
    damping, count = 1e-4, 0
    normal, gradient, cost = _assemble(state, seen, prior, sigma, robust)
    while count < iterations:
        count += 1
        if tick is not None:
            tick()
        step = _step(normal[np.ix_(mask, mask)], gradient[mask], damping)
        full = np.zeros(len(mask))
        full[mask] = step
        trial = _moved(state, full)
        trial_cost = _cost(trial, seen, prior, sigma, robust)
        if trial_cost < cost:
            gain = cost - trial_cost
            state, damping = trial, max(damping / 5, 1e-12)
            normal, gradient, cost = _assemble(state, seen, prior, sigma, robust)
            if gain < TOLERANCE * cost + 1e-12:
                break
        else:
            damping *= 8
            if damping > 1e8:
                break
    return Solution(state, normal[np.ix_(mask, mask)], mask, cost, count)


def _free_mask(state: State, free: Free) -> Bool[np.ndarray, " q"]:
    cameras, shots = len(state.intrinsics), len(state.board_rotations)
    per_camera = np.zeros((cameras, PER_CAMERA), dtype=bool)
    per_camera[:, : len(INTRINSICS)] = free.intrinsics
    per_camera[1:, len(INTRINSICS) :] = free.poses
    offsets = np.full(cameras, free.offsets)
    offsets[0] = False
    return np.concatenate([per_camera.ravel(), np.full(shots * PER_SHOT, free.boards), offsets])


def _step(normal: np.ndarray, gradient: np.ndarray, damping: float) -> np.ndarray:
    scale = 1.0 / np.sqrt(np.diag(normal) + 1e-12)
    scaled = normal * np.outer(scale, scale)
    while True:
        try:
            lower = dense.factor(scaled + damping * np.eye(len(scaled)))
            return -scale * dense.solve(lower, (scale * gradient)[:, None])[:, 0]
        except dense.NotPositiveDefinite:
            damping = max(10 * damping, 1e-10)


def _cost(state: State, seen: Observations, prior: Prior, sigma: np.ndarray, robust: str) -> float:
    squares = (residuals(state, seen) ** 2).sum(axis=1) / sigma[seen.camera[seen.view_of]] ** 2
    if robust == "cauchy":
        total = float((4.0 * np.log1p(squares / 4.0)).sum())
    elif robust == "huber":
        root = np.sqrt(squares)
        total = float(np.where(root < HUBER, squares, 2 * HUBER * root - HUBER**2).sum())
    else:
        total = float(squares.sum())
    miss = state.intrinsics - prior.mean
    focal = state.intrinsics[:, 0] + state.intrinsics[:, 1]
    aspect = 2 * (state.intrinsics[:, 0] - state.intrinsics[:, 1]) / focal / ASPECT_PRIOR
    return total + float(np.einsum("ci,cij,cj->", miss, prior.information, miss) + (aspect**2).sum())


def _assemble(
    state: State, seen: Observations, prior: Prior, sigma: np.ndarray, robust: str
) -> tuple[np.ndarray, np.ndarray, float]:
    """Normal matrix, gradient (half the cost's) and cost."""
    cameras, shots = len(state.intrinsics), len(state.board_rotations)
    miss, by_camera, by_board, by_offset = _jacobians(state, seen)
    noise = sigma[seen.camera[seen.view_of]]
    weight = np.sqrt(robust_weights((miss**2).sum(axis=1) / noise**2, robust)) / noise
    blocks = np.concatenate([by_camera, by_board, by_offset[:, :, None], miss[:, :, None]], axis=2)
    blocks = (blocks * weight[:, None, None]).reshape(2 * len(miss), -1)
    size = cameras * PER_CAMERA + shots * PER_SHOT + cameras
    normal, gradient = np.zeros((size, size)), np.zeros(size)
    for view, (camera, shot) in enumerate(zip(seen.camera, seen.shot, strict=True)):
        block = blocks[2 * seen.starts[view] : 2 * seen.starts[view + 1]]
        product = block.T @ block
        first = cameras * PER_CAMERA + shot * PER_SHOT
        at = np.concatenate(
            [
                np.arange(camera * PER_CAMERA, (camera + 1) * PER_CAMERA),
                np.arange(first, first + PER_SHOT),
                [size - cameras + camera],
            ]
        )
        normal[np.ix_(at, at)] += product[:-1, :-1]
        gradient[at] += product[:-1, -1]
    _add_prior(state, prior, normal, gradient)
    return normal, gradient, _cost(state, seen, prior, sigma, robust)


def _add_prior(state: State, prior: Prior, normal: np.ndarray, gradient: np.ndarray) -> None:
    for camera, values in enumerate(state.intrinsics):
        first = camera * PER_CAMERA
        own = slice(first, first + len(INTRINSICS))
        normal[own, own] += prior.information[camera]
        gradient[own] += prior.information[camera] @ (values - prior.mean[camera])
        fx, fy = values[:2]
        aspect = 2 * (fx - fy) / (fx + fy) / ASPECT_PRIOR
        slope = np.array([4 * fy, -4 * fx]) / (fx + fy) ** 2 / ASPECT_PRIOR
        normal[first : first + 2, first : first + 2] += np.outer(slope, slope)
        gradient[first : first + 2] += slope * aspect


def _moved(state: State, step: Float[np.ndarray, " q"]) -> State:
    cameras, shots = len(state.intrinsics), len(state.board_rotations)
    per_camera = step[: cameras * PER_CAMERA].reshape(cameras, PER_CAMERA)
    per_shot = step[cameras * PER_CAMERA : cameras * PER_CAMERA + shots * PER_SHOT].reshape(shots, PER_SHOT)
    turns, shifts = _motions(per_camera[:, len(INTRINSICS) :])
    board_turns, board_shifts = _motions(per_shot)
    return replace(
        state,
        intrinsics=state.intrinsics + per_camera[:, : len(INTRINSICS)],
        camera_rotations=turns @ state.camera_rotations,
        camera_translations=(turns @ state.camera_translations[:, :, None])[:, :, 0] + shifts,
        board_rotations=board_turns @ state.board_rotations,
        board_translations=(board_turns @ state.board_translations[:, :, None])[:, :, 0] + board_shifts,
        offsets=state.offsets + step[len(step) - cameras :],
    )


def _motions(steps: Float[np.ndarray, "n 6"]) -> tuple[Float[np.ndarray, "n 3 3"], Float[np.ndarray, "n 3"]]:
    turns = np.stack([rotation_from_vector(step[:3]) for step in steps]) if len(steps) else np.zeros((0, 3, 3))
    return turns, steps[:, 3:]


def orthonormal(state: State) -> State:
    """Takes the rounding of many small turns out of the rotations."""
    return replace(
        state,
        camera_rotations=np.stack([nearest_rotation(r) for r in state.camera_rotations]),
        board_rotations=np.stack([nearest_rotation(r) for r in state.board_rotations]),
    )


def _points(state: State, seen: Observations) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """World and camera coordinates of all corners, and the camera index of each."""
    camera, shot = seen.camera[seen.view_of], seen.shot[seen.view_of]
    world = np.einsum("nij,nj->ni", state.board_rotations[shot], seen.points) + state.board_translations[shot]
    if state.offsets.any():
        motion = state.velocities[shot] * state.offsets[camera][:, None]
        # The offsets are small: the board's motion is taken to first order.
        world = world + np.cross(motion[:, :3], world) + motion[:, 3:]
    inside = np.einsum("nij,nj->ni", state.camera_rotations[camera], world) + state.camera_translations[camera]
    return world, inside, camera


def _project(state: State, seen: Observations) -> tuple[np.ndarray, np.ndarray, np.ndarray, np.ndarray]:
    world, points, camera = _points(state, seen)
    fx, fy, cx, cy, k1, k2, p1, p2, k3 = state.intrinsics[camera].T
    behind = points[:, 2] < 1e-3
    z = np.where(behind, 1.0, points[:, 2])
    x, y = points[:, 0] / z, points[:, 1] / z
    r2 = x * x + y * y
    radial = 1 + r2 * (k1 + r2 * (k2 + r2 * k3))
    u = fx * (x * radial + 2 * p1 * x * y + p2 * (r2 + 2 * x * x)) + cx
    v = fy * (y * radial + p1 * (r2 + 2 * y * y) + 2 * p2 * x * y) + cy
    pixels = np.stack([u, v], axis=1)
    pixels[behind] = seen.pixels[behind] + 1e3
    return pixels, world, points, camera


def _jacobians(state: State, seen: Observations) -> tuple[np.ndarray, np.ndarray, np.ndarray, np.ndarray]:
    """Residuals (n, 2), and their derivatives by camera (n, 2, 15), board (n, 2, 6) and time offset (n, 2)."""
    pixels, world, points, camera = _project(state, seen)
    fx, fy, _, _, k1, k2, p1, p2, k3 = state.intrinsics[camera].T
    z = np.maximum(points[:, 2], 1e-3)
    x, y = points[:, 0] / z, points[:, 1] / z
    r2 = x * x + y * y
    radial = 1 + r2 * (k1 + r2 * (k2 + r2 * k3))
    slope = 2 * (k1 + r2 * (2 * k2 + 3 * r2 * k3))
    cross = slope * x * y + 2 * p1 * x + 2 * p2 * y
    ux, uy = fx * (radial + slope * x * x + 2 * p1 * y + 6 * p2 * x), fx * cross
    vx, vy = fy * cross, fy * (radial + slope * y * y + 6 * p1 * y + 2 * p2 * x)
    zero, one = np.zeros_like(x), np.ones_like(x)
    by_point = np.stack(
        [
            np.stack([ux / z, uy / z, -(ux * x + uy * y) / z], axis=1),
            np.stack([vx / z, vy / z, -(vx * x + vy * y) / z], axis=1),
        ],
        axis=1,
    )
    lens_u = [x * r2, x * r2**2, 2 * x * y, r2 + 2 * x * x, x * r2**3]
    lens_v = [y * r2, y * r2**2, r2 + 2 * y * y, 2 * x * y, y * r2**3]
    distorted_x = x * radial + 2 * p1 * x * y + p2 * (r2 + 2 * x * x)
    distorted_y = y * radial + p1 * (r2 + 2 * y * y) + 2 * p2 * x * y
    row_u = [distorted_x, zero, one, zero, *(fx * term for term in lens_u)]
    row_v = [zero, distorted_y, zero, one, *(fy * term for term in lens_v)]
    by_intrinsics = np.stack([np.stack(row_u, axis=1), np.stack(row_v, axis=1)], axis=1)
    by_world = by_point @ state.camera_rotations[camera]
    by_camera = np.concatenate([by_intrinsics, by_point @ _minus_cross(points), by_point], axis=2)
    by_board = np.concatenate([by_world @ _minus_cross(world), by_world], axis=2)
    by_offset = np.einsum("nij,nj->ni", by_board, state.velocities[seen.shot[seen.view_of]])
    behind = points[:, 2] < 1e-3
    for array in (by_camera, by_board, by_offset):
        array[behind] = 0.0
    return pixels - seen.pixels, by_camera, by_board, by_offset


def _minus_cross(points: Float[np.ndarray, "n 3"]) -> Float[np.ndarray, "n 3 3"]:
    """-[x]x of every row: the derivative of a rotated point by the rotation vector."""
    x, y, z = points.T
    zero = np.zeros_like(x)
    rows = [np.stack([zero, z, -y], 1), np.stack([-z, zero, x], 1), np.stack([y, -x, zero], 1)]
    return np.stack(rows, axis=1)
