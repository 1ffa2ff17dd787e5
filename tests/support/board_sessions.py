"""Planted truth for the calibration: a rig, board poses and noisy corners."""

from dataclasses import dataclass

import numpy as np

from calibration.adjustment.state import BundleState
from calibration.board.board import Board, board_poses
from calibration.board.corners import Found
from calibration.board.detection import Detections, View
from rig.camera import Camera, Distortion, Intrinsics
from rig.geometry import RigidTransform, look_at
from rig.rig import Rig

CHECKERBOARD = Board("checkerboard", 9, 6, 25.0)
CHARUCO = Board("charuco", 9, 6, 25.0, dictionary="DICT_5X5_100")


def rig_of(
    count: int, rng: np.random.Generator, *, width: int = 1024, height: int = 768, distance: float = 1000.0
) -> Rig:
    """``count`` cameras on the front hemisphere in the project's world frame, cam00 ...; the middle one in front."""
    cameras = []
    for i, azimuth in enumerate(np.radians(np.linspace(-80, 80, count))):
        elevation = np.radians([-15.0, 20.0, 5.0][i % 3]) if i != count // 2 else 0.0
        direction = [np.sin(azimuth) * np.cos(elevation), np.sin(elevation), np.cos(azimuth) * np.cos(elevation)]
        centre = distance * np.array(direction) * rng.uniform(0.92, 1.08)
        focal = 1.55 * width * rng.uniform(0.97, 1.03)
        lens = Distortion(*(rng.normal(size=5) * [0.06, 0.05, 5e-4, 5e-4, 0.0]))
        cx, cy = (width - 1) / 2 + rng.normal(scale=6.0), (height - 1) / 2 + rng.normal(scale=6.0)
        intrinsics = Intrinsics(width, height, focal, focal * rng.uniform(0.998, 1.002), cx, cy, lens)
        aim = rng.normal(scale=15.0, size=3)
        cameras.append(Camera(f"cam{i:02d}", intrinsics, look_at(centre, aim, np.array([0.0, 1.0, 0.0]))))
    return Rig(tuple(cameras))


@dataclass(frozen=True, slots=True, eq=False)
class Session:
    """What was planted, and what a detector with Gaussian noise would have found."""

    rig: Rig
    poses: dict[str, RigidTransform]
    detections: Detections


def session(
    board: Board = CHECKERBOARD, *, cameras: int = 11, shots: int = 30, noise_px: float = 0.2, seed: int = 0
) -> Session:
    rng = np.random.default_rng(seed)
    rig = rig_of(cameras, rng)
    poses = {f"shot{i:02d}": pose for i, pose in enumerate(board_poses(board, shots, rng))}
    views = [
        View(camera.name, shot, Found(ids, pixels + rng.normal(scale=noise_px, size=pixels.shape), 1.5))
        for camera in rig
        for shot, pose in poses.items()
        for ids, pixels in [visible(camera, pose, board)]
        if len(ids) >= 6
    ]
    sizes = {camera.name: (camera.intrinsics.width, camera.intrinsics.height) for camera in rig}
    return Session(rig, poses, Detections(board, sizes, tuple(poses), tuple(views)))


def visible(camera: Camera, world_from_board: RigidTransform, board: Board) -> tuple[np.ndarray, np.ndarray]:
    """Numbers and pixels of the corners that ``camera`` sees: face towards it by 25 degrees at least, all in the image
    for a checkerboard."""
    camera_from_board = camera.camera_from_world @ world_from_board
    normal = camera_from_board.rotation[:, 2]
    sight = camera_from_board.apply(board.centre()[None])[0]
    pixels = camera.project(world_from_board.apply(board.corners()))
    k = camera.intrinsics
    inside = (pixels >= 4).all(axis=1) & (pixels[:, 0] < k.width - 4) & (pixels[:, 1] < k.height - 4)
    if normal @ sight / np.linalg.norm(sight) < np.sin(np.radians(25)):
        inside[:] = False
    if board.kind == "checkerboard" and not inside.all():
        inside[:] = False
    return np.flatnonzero(inside), pixels[inside]


def planted(source: Session) -> BundleState:
    """Returns the true cameras and the true poses of the board as the state of a bundle."""
    rig, shots = source.rig, source.detections.shots
    return BundleState(
        np.stack([camera.intrinsics.values() for camera in rig]),
        np.stack([camera.camera_from_world.rotation for camera in rig]),
        np.stack([camera.camera_from_world.translation for camera in rig]),
        np.stack([source.poses[shot].rotation for shot in shots]),
        np.stack([source.poses[shot].translation for shot in shots]),
        np.zeros(len(rig)),
        np.zeros((len(shots), 6)),
    )
