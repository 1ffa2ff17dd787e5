"""Planted truth for the calibration: a rig, board poses, noisy corners, and rendered pictures of the board.

The pictures come from OpenCV's or numpy's drawing of the pattern and ray casting through ``Camera.rays_world``; nothing
of ``calibration.board.board``'s drawing is used.
"""

from dataclasses import dataclass

import cv2
import numpy as np
from scipy.interpolate import RectBivariateSpline

from calibration.board.board import Board
from calibration.board.corners import Found
from calibration.board.detection import Detections, View
from rig.camera import Camera, Distortion, Intrinsics
from rig.geometry import RigidTransform, look_at, rotation_from_vector
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


def board_poses(board: Board, count: int, rng: np.random.Generator) -> list[RigidTransform]:
    """world_from_board: the board's face turned towards azimuths over the whole fan, tilted and rolled."""
    poses = []
    for i in range(count):
        azimuth = np.radians(-75 + 150 * (i + 0.5) / count)
        # The board's z points away from the viewer: for a viewer on +z of the world, x right is world x, y down is -y.
        upright = np.diag([1.0, -1.0, -1.0])
        turn = rotation_from_vector(np.array([0.0, azimuth, 0.0]))
        tilt = rotation_from_vector(np.radians(rng.uniform(-35, 35, 3)))
        rotation = turn @ tilt @ upright
        centre = rng.uniform(-60, 60, 3)
        poses.append(RigidTransform(rotation, centre - rotation @ board.centre()))
    return poses


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
    return Session(rig, poses, Detections(board, sizes, tuple(poses), tuple(views), ()))


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


def pattern(board: Board, pixels_per_square: int = 40, margin: int = 1) -> np.ndarray:
    """The printed sheet, with ``margin`` squares of paper around the pattern."""
    size = (board.columns * pixels_per_square, board.rows * pixels_per_square)
    if board.kind == "charuco":
        sheet = board.opencv().generateImage(size)
    else:
        row, column = np.indices((board.rows, board.columns))
        squares = np.where((row + column) % 2 == 0, 0, 255).astype(np.uint8)
        sheet = np.kron(squares, np.ones((pixels_per_square, pixels_per_square), np.uint8))
    sheet = np.pad(sheet, margin * pixels_per_square, constant_values=255)
    return 255 - sheet if board.inverted else sheet


def photograph(
    camera: Camera, world_from_board: RigidTransform, board: Board, rng: np.random.Generator, *, blur_px: float = 0.6
) -> np.ndarray:
    """A grey picture (uint8) of the board before a plain wall."""
    k, scale, side = camera.intrinsics, 40, 2
    # Rays are cast through every eighth pixel; a cubic spline between them is exact to 1e-4 of a square.
    us, vs = np.arange(-8.0, k.width + 16, 8), np.arange(-8.0, k.height + 16, 8)
    pixels = np.stack(np.meshgrid(us, vs), axis=-1).reshape(-1, 2)
    board_from_world = world_from_board.inverse()
    rays = camera.rays_world(pixels) @ board_from_world.rotation.T
    centre = board_from_world.apply(camera.centre_world[None])[0]
    with np.errstate(divide="ignore", invalid="ignore"):
        hit = centre[:2] - centre[2] / rays[:, 2:] * rays[:, :2]
    sheet = pattern(board, scale)
    nodes = ((hit / board.square_mm + 1.0) * scale - 0.5).reshape(len(vs), len(us), 2)
    fine = [(np.arange(size * side) + 0.5) / side - 0.5 for size in (k.height, k.width)]
    x, y = (RectBivariateSpline(vs, us, nodes[..., axis])(fine[0], fine[1]).astype(np.float32) for axis in range(2))
    picture = cv2.remap(sheet, x, y, cv2.INTER_AREA, borderMode=cv2.BORDER_CONSTANT, borderValue=120)
    picture = cv2.resize(picture, (k.width, k.height), interpolation=cv2.INTER_AREA).astype(float)
    picture = cv2.GaussianBlur(picture, (0, 0), blur_px) if blur_px else picture
    return np.clip(0.75 * picture + 25 + rng.normal(scale=2.0, size=picture.shape), 0, 255).astype(np.uint8)
