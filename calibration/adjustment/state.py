"""Defines the unknowns of a bundle adjustment (the state) and its observations, and projects the board's corners.

A perturbation multiplies a pose from the left, as in ``Camera.covariance``."""

from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np
from jaxtyping import Bool, Float, Int

from calibration.board.board import Board
from calibration.board.detection import View
from rig.camera import Camera, Distortion, Intrinsics, lens_image
from rig.geometry import RigidTransform, nearest_rotation, rotation_from_vector

INTRINSICS = ("fx", "fy", "cx", "cy", "k1", "k2", "p1", "p2", "k3")
PER_CAMERA, PER_SHOT = len(INTRINSICS) + 6, 6
BEHIND_PX = 1e3  # residual of a corner that lies behind its camera
DEPTH_LEAST_MM = 1e-3


@dataclass(frozen=True, slots=True, eq=False)
class Observations:
    """Holds the detected corners of all views, sorted by view. ``camera`` and ``shot`` are each view's indices into the
    state. View v has the corners from ``starts[v]`` to ``starts[v + 1]``."""

    camera: Int[np.ndarray, " v"]
    shot: Int[np.ndarray, " v"]
    starts: Int[np.ndarray, " v+1"]
    points: Float[np.ndarray, "n 3"]  # board frame, mm
    pixels: Float[np.ndarray, "n 2"]

    @property
    def view_of(self) -> Int[np.ndarray, " n"]:
        """Returns, for each corner, the index of its view."""
        return np.repeat(np.arange(len(self.camera)), np.diff(self.starts))

    def subset(self, retained: Bool[np.ndarray, " n"]) -> "Observations":
        """Returns the corners that ``retained`` marks. All views of the board remain, possibly without corners."""
        counts = np.bincount(self.view_of[retained], minlength=len(self.camera))
        starts = np.concatenate([[0], np.cumsum(counts)])
        return replace(self, starts=starts, points=self.points[retained], pixels=self.pixels[retained])


@dataclass(frozen=True, slots=True, eq=False)
class BundleState:
    """Holds the estimated intrinsics (fx fy cx cy k1 k2 p1 p2 k3), camera_from_world and world_from_board (mm).

    ``offsets`` is the time offset of each camera, in intervals between shots. ``velocities`` is the motion of the board
    from one shot to the next (rad, mm)."""

    intrinsics: Float[np.ndarray, "c 9"]
    camera_rotations: Float[np.ndarray, "c 3 3"]
    camera_translations: Float[np.ndarray, "c 3"]
    board_rotations: Float[np.ndarray, "s 3 3"]
    board_translations: Float[np.ndarray, "s 3"]
    offsets: Float[np.ndarray, " c"]
    velocities: Float[np.ndarray, "s 6"]

    def camera_pose(self, index: int) -> RigidTransform:
        """Returns camera_from_world of the camera at ``index``."""
        return RigidTransform(self.camera_rotations[index], self.camera_translations[index])


def observe_views(views: Sequence[View], cameras: Sequence[str], shots: Sequence[str], board: Board) -> Observations:
    """Collects the pixels of all views' corners and their positions on the board (mm)."""
    corners = board.corners()
    counts = [len(view.found.ids) for view in views]
    return Observations(
        np.array([cameras.index(view.camera) for view in views], dtype=int),
        np.array([shots.index(view.shot) for view in views], dtype=int),
        np.concatenate([[0], np.cumsum(counts)]).astype(int),
        np.concatenate([corners[view.found.ids] for view in views]),
        np.concatenate([view.found.corners for view in views]),
    )


def intrinsics_of(values: Float[np.ndarray, " 9"], size: tuple[int, int]) -> Intrinsics:
    """Builds intrinsics from the values ``fx fy cx cy k1 k2 p1 p2 k3``; ``size`` is width and height, px."""
    fx, fy, cx, cy, *lens = (float(value) for value in values)
    return Intrinsics(*size, fx, fy, cx, cy, Distortion(*lens))


def camera_of(state: BundleState, index: int, name: str, size: tuple[int, int]) -> Camera:
    """Returns the camera at ``index`` of a state, with its pose in mm; ``size`` is width and height, px."""
    return Camera(name, intrinsics_of(state.intrinsics[index], size), state.camera_pose(index))


def moved_state(state: BundleState, step: Float[np.ndarray, " q"]) -> BundleState:
    """Returns the state after adding ``step`` to all parameters: cameras (intrinsics, pose), boards, time offsets."""
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
    return rotation_from_vector(steps[:, :3]), steps[:, 3:]


def orthonormal(state: BundleState) -> BundleState:
    """Makes all rotations of the state orthonormal again, which rounding errors of many steps spoil."""
    return replace(
        state,
        camera_rotations=np.stack([nearest_rotation(r) for r in state.camera_rotations]),
        board_rotations=np.stack([nearest_rotation(r) for r in state.board_rotations]),
    )


def corner_positions(
    state: BundleState, observed: Observations
) -> tuple[Float[np.ndarray, "n 3"], Float[np.ndarray, "n 3"], Int[np.ndarray, " n"]]:
    """Returns all corners in the world frame and in their camera's frame (mm), and each corner's camera index."""
    camera, shot = observed.camera[observed.view_of], observed.shot[observed.view_of]
    world = np.einsum("nij,nj->ni", state.board_rotations[shot], observed.points) + state.board_translations[shot]
    if state.offsets.any():
        motion = state.velocities[shot] * state.offsets[camera][:, None]
        # The offsets are small: the board's motion is taken to first order.
        world = world + np.cross(motion[:, :3], world) + motion[:, 3:]
    inside = np.einsum("nij,nj->ni", state.camera_rotations[camera], world) + state.camera_translations[camera]
    return world, inside, camera


def residuals(state: BundleState, observed: Observations) -> Float[np.ndarray, "n 2"]:
    """Returns projected minus detected pixels of each corner. Corners behind their camera get ``BEHIND_PX``."""
    _, inside, camera = corner_positions(state, observed)
    behind = inside[:, 2] < DEPTH_LEAST_MM
    inside[behind] = (0.0, 0.0, 1.0)
    miss = lens_image(inside, state.intrinsics[camera]) - observed.pixels
    miss[behind] = BEHIND_PX
    return miss


def rms(misses: Float[np.ndarray, "n 2"]) -> float:
    """Returns the root mean square length of 2D residuals (px), or 0 without residuals."""
    return float(np.sqrt((misses**2).sum(axis=1).mean())) if len(misses) else 0.0
