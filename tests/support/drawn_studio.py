"""A studio of six cameras with a drawn head in it: five around the front, one behind, small pictures."""

from collections.abc import Collection
from functools import cache
from pathlib import Path

import numpy as np

from rig.camera import Camera, Intrinsics
from rig.capture import Capture, ImageRgb
from rig.formats.captures.capture_folder import write_capture
from rig.geometry import Similarity, look_at, rotation_from_vector
from rig.rig import Rig
from tests.support.drawn_faces import WALL, photographed_face

DIRECTIONS_DEG = ((0, 0), (-30, 5), (30, 10), (0, 25), (-50, 0), (180, 0))
LENS = Intrinsics(320, 240, 450.0, 450.0, 159.5, 119.5)


def drawn_studio() -> Rig:
    """cam0 is in front; cam1 and cam4 stand to its left, cam2 to its right, cam3 above, cam5 behind the head."""
    cameras = []
    for k, (azimuth, elevation) in enumerate(np.radians(DIRECTIONS_DEG)):
        away = np.array([np.sin(azimuth) * np.cos(elevation), np.sin(elevation), np.cos(azimuth) * np.cos(elevation)])
        cameras.append(Camera(f"cam{k}", LENS, look_at(1000.0 * away, np.zeros(3), np.array([0.0, 1.0, 0.0]))))
    return Rig(tuple(cameras))


@cache
def drawn_pictures(left_deg: float = 0.0, up_deg: float = 0.0) -> dict[str, ImageRgb]:
    """A head that is turned to its left and up, from straight into cam0."""
    turn = rotation_from_vector(np.radians([-up_deg, 0.0, 0.0]))
    head = Similarity(1.0, rotation_from_vector(np.radians([0.0, left_deg, 0.0])) @ turn, np.zeros(3))
    return {camera.name: photographed_face(camera, head) for camera in drawn_studio()}


def hidden_from(names: Collection[str], pictures: dict[str, ImageRgb]) -> dict[str, ImageRgb]:
    """The pictures with a board before the lenses of some cameras, with noise."""
    boards = np.random.default_rng(0).normal(WALL, 2.0, (len(pictures), LENS.height, LENS.width, 3))
    shown = dict(zip(pictures, np.clip(boards, 0, 255).astype(np.uint8), strict=True))
    return {name: shown[name] if name in names else picture for name, picture in pictures.items()}


def write_drawn_capture(folder: Path, left_deg: float = 0.0, hidden: Collection[str] = ()) -> Path:
    """A capture folder of it, without plates and masks."""
    write_capture(folder, Capture(hidden_from(hidden, drawn_pictures(left_deg))), drawn_studio())
    return folder
