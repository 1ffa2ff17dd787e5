"""A fan of cameras with lenses, the names of its file in every format, and pictures for those that want them."""

from dataclasses import replace
from pathlib import Path

import numpy as np

from rig.camera import Camera, Distortion, Intrinsics
from rig.formats.cameras.cameras_file import find_rig_file
from rig.formats.pictures.images import write_image
from rig.geometry import look_at
from rig.rig import Rig
from tests.support.changed_rigs import relensed

POINTS = np.random.default_rng(4).uniform(-80.0, 80.0, (20, 3))


def fan(count: int = 5) -> Rig:
    cameras = []
    for i, azimuth in enumerate(np.linspace(-1.2, 1.2, count)):
        centre = np.array([900 * np.sin(azimuth), 90.0 * i - 150, 900 * np.cos(azimuth)])
        lens = Distortion(-0.11 + 0.02 * i, 0.05, 1e-3 * i, -7e-4, 0.013)
        intrinsics = Intrinsics(1024 + i, 768, 1500.0 + i, 1510.0, 511.5 + i, 380.25, lens)
        cameras.append(Camera(f"cam{i:02d}", intrinsics, look_at(centre, np.zeros(3), np.array([0.0, 1.0, 0.0]))))
    return Rig(tuple(cameras))


def write_blanks(rig: Rig, folder: Path) -> None:
    """Writes a black picture for each camera, since some formats leave the size to the pictures."""
    for camera in rig:
        pixels = np.zeros((camera.intrinsics.height, camera.intrinsics.width), np.uint8)
        write_image(folder / "images" / f"{camera.name}.png", pixels)


def find_cameras(folder: Path) -> Path:
    """Returns the file of cameras in ``folder``."""
    found = find_rig_file(folder)
    assert found is not None
    return found


NAMES = {
    "eigenhead": "cameras.json",
    "colmap": "sparse/0",
    "colmap-text": "sparse/0",
    "caliscope": "camera_array.toml",
    "aniposelib": "calibration.toml",
    "metashape": "cameras.xml",
    "realitycapture": "images",
    "realitycapture-csv": "cameras.csv",
    "nerfstudio": "transforms.json",
    "opencv-yaml": ".",
    "blender": "cameras.py",
}


def square(rig: Rig) -> Rig:
    """The rig with square pixels, which is all that some formats know."""
    return relensed(rig, lambda intrinsics: replace(intrinsics, fy=intrinsics.fx))
