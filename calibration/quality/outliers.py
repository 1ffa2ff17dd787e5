"""Finds views and shots that contradict the rest of the rig, and explains why. Every excluded view is reported."""

from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np
from jaxtyping import Float

from calibration.adjustment.intrinsics import Lens
from calibration.adjustment.state import BundleState, Observations, intrinsics_of, residuals
from calibration.board.board import Board
from calibration.board.detection import Detections, View
from rig.camera import Camera
from rig.geometry import RigidTransform, nearest_to_rays, rigid_fit
from rig.messages.message import Message, compose

# A view is out if its RMS is this many times the median view's: with Gaussian corners the ratio passes 1.5 once in 1e4
# views; moments that differ between cameras spread it to 5.
VIEW_RATIO, VIEW_LEAST_PX = 7.0, 1.0
CORNER_SIGMAS = 5.0
BLUR_SQUARES, BLUR_PX = 0.2, 4.0  # wider than both: the edge's place depends on how the board moved in the exposure
MATCH_RATIO = 3.0  # an explanation must bring a view this much closer than it was


@dataclass(frozen=True, slots=True)
class Dropped:
    """Holds an excluded view and the reason. If ``camera`` is None, the whole shot is excluded."""

    shot: str
    camera: str | None
    reason: Message

    def message(self) -> Message:
        """Returns a message with the shot, the camera and the reason."""
        if self.camera is None:
            return compose("dropped-shot", shot=self.shot, reason=self.reason)
        return compose("dropped-view", shot=self.shot, camera=self.camera, reason=self.reason)

    def __str__(self) -> str:
        return self.message().text


def drop_blurred(detections: Detections) -> tuple[Detections, list[Dropped]]:
    """Removes views whose edges are too blurred to locate corners. Returns the other detections, and the removed views
    with the reason."""
    retained, dropped = [], []
    for view in detections.views:
        side = square_side_px(view, detections.board)
        if view.found.rise_px > max(BLUR_PX, BLUR_SQUARES * side):
            width_px = view.found.rise_px
            endless = compose("view-blurred-beyond") if np.isinf(width_px) else None
            dropped.append(Dropped(view.shot, view.camera, endless or compose("view-blurred", width_px=width_px)))
        else:
            retained.append(view)
    return replace(detections, views=tuple(retained)), dropped


def square_side_px(view: View, board: Board) -> float:
    """Returns the median side (px) of the board's squares in a view, or 0 if no two corners are neighbours."""
    columns = board.grid[0]
    corner_of = dict(zip(view.found.ids.tolist(), view.found.corners, strict=True))
    sides = [
        float(np.linalg.norm(corner_of[i + step] - corner))
        for i, corner in corner_of.items()
        for step in (1, columns)
        if i + step in corner_of and (step > 1 or (i + 1) % columns)
    ]
    return float(np.median(sides)) if sides else 0.0


def drop_misread(detections: Detections, lenses: dict[str, Lens]) -> tuple[Detections, list[Dropped]]:
    """Removes views in which no pose of a flat board fits the corners. Returns the other detections, and the removed
    views with the reason."""
    retained, dropped = [], []
    for view in detections.views:
        lens = lenses[view.camera]
        rms = miss(
            view, Camera("", lens.intrinsics, RigidTransform.identity()), lens.poses[view.shot], detections.board
        )
        if rms > max(VIEW_RATIO * lens.noise_px, VIEW_LEAST_PX):
            dropped.append(Dropped(view.shot, view.camera, compose("corners-off-board", rms_px=rms)))
        else:
            retained.append(view)
    return replace(detections, views=tuple(retained)), dropped


def view_rms(state: BundleState, observed: Observations) -> Float[np.ndarray, " v"]:
    """Returns the RMS reprojection error (px) of each view."""
    squares = (residuals(state, observed) ** 2).sum(axis=1)
    counts = np.bincount(observed.view_of, minlength=len(observed.camera))
    return np.sqrt(np.bincount(observed.view_of, squares, minlength=len(observed.camera)) / np.maximum(counts, 1))


def bad_views(state: BundleState, observed: Observations) -> np.ndarray:
    """Returns a mask of the views that the joint solution does not fit. Another camera of the same shot may be at
    fault, which ``explain_shot`` decides."""
    rms = view_rms(state, observed)
    return rms > max(VIEW_RATIO * float(np.median(rms)), VIEW_LEAST_PX)


def explain_shot(
    shot: str,
    views: Sequence[View],
    bad: Sequence[View],
    detections: Detections,
    state: BundleState,
    *,
    names: Sequence[str],
    boards: dict[str, RigidTransform],
    noise_px: float,
) -> list[Dropped]:
    """Decides which views of a shot to exclude, and why. The joint solution does not fit the views ``bad``."""
    cameras = {
        name: Camera(name, intrinsics_of(state.intrinsics[i], detections.sizes[name]), state.camera_pose(i))
        for i, name in enumerate(names)
    }
    scale = estimate_board_scale(views, cameras, detections.board, boards[shot])
    if scale is not None:
        size, rms = scale
        if abs(size - 1) > 0.01 and rms < max(MATCH_RATIO * noise_px, VIEW_LEAST_PX):
            real = size * detections.board.square_mm
            reason = compose("squares-of-other-board", real_mm=real, square_mm=detections.board.square_mm)
            return [Dropped(shot, None, reason)]
    if len(bad) > len(views) / 2:
        return [Dropped(shot, None, compose("board-moved-between"))]
    return [Dropped(shot, view.camera, _why(view, cameras, detections, boards, noise_px)) for view in bad]


def _why(
    view: View, cameras: dict[str, Camera], detections: Detections, boards: dict[str, RigidTransform], noise_px: float
) -> Message:
    """Explains why a view contradicts the rig, for example because its picture belongs to another camera or shot."""
    limit = max(10 * noise_px, 3.0)
    for name, camera in cameras.items():
        alike = name != view.camera and detections.sizes[name] == detections.sizes[view.camera]
        if alike and miss(view, camera, boards[view.shot], detections.board) < limit:
            return compose("picture-of-camera", camera=name)
    for shot, pose in boards.items():
        if shot != view.shot and miss(view, cameras[view.camera], pose, detections.board) < limit:
            return compose("picture-of-shot", shot=shot)
    return compose("view-contradicts")


def miss(view: View, camera: Camera, world_from_board: RigidTransform, board: Board) -> float:
    """Returns the RMS distance (px) between a view's corners and their projections, in the best turn of the board."""
    values = []
    for turn in board.turns():
        points = world_from_board.apply(board.corners()[turn[view.found.ids]])
        apart = camera.project(points) - view.found.corners
        values.append(float(np.sqrt((apart**2).sum(axis=1).mean())) if np.isfinite(apart).all() else np.inf)
    return min(values)


def estimate_board_scale(
    views: Sequence[View], cameras: dict[str, Camera], board: Board, start: RigidTransform
) -> tuple[float, float] | None:
    """Estimates the board's size in a shot relative to its description, and the RMS error (px) at that size. Returns
    None with too few cameras or corners."""
    if len({view.camera for view in views}) < 2:
        return None
    triples = [(cameras[v.camera], board.corners()[v.found.ids], v.found.corners) for v in views]
    shared = _triangulated(triples, [v.found.ids for v in views])
    if shared is None:
        return None
    ids, points = shared
    flat = board.corners()[ids]
    spread = np.sqrt(((flat - flat.mean(axis=0)) ** 2).sum())
    size = float(np.sqrt(((points - points.mean(axis=0)) ** 2).sum()) / spread)
    board_pose = rigid_fit(size * flat, points)
    misses = [camera.project(board_pose.apply(size * corners)) - pixels for camera, corners, pixels in triples]
    squares = np.concatenate([(m**2).sum(axis=1) for m in misses])
    return size, float(np.sqrt(squares.mean())) if np.isfinite(squares).all() else np.inf


def _triangulated(
    triples: Sequence[tuple[Camera, np.ndarray, np.ndarray]], ids: Sequence[np.ndarray]
) -> tuple[np.ndarray, Float[np.ndarray, "n 3"]] | None:
    """Returns the numbers and triangulated positions of the corners that two or more cameras see, or None if too
    few."""
    counts = np.bincount(np.concatenate(ids))
    wanted = np.flatnonzero(counts >= 2)
    if len(wanted) < 4:
        return None
    rays, weights = np.zeros((len(triples), len(counts), 3)), np.zeros((len(triples), len(counts)))
    for view, ((camera, _, pixels), numbers) in enumerate(zip(triples, ids, strict=True)):
        rays[view, numbers], weights[view, numbers] = camera.rays_world(pixels), 1.0
    if not np.isfinite(rays).all():
        return None
    centres = np.stack([camera.centre_world for camera, _, _ in triples])
    return wanted, nearest_to_rays(centres, rays[:, wanted], weights[:, wanted], ridge=0.0)
