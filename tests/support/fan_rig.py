"""A fan of cameras with lenses, and the names of its file in every format."""

from dataclasses import replace
from pathlib import Path

import numpy as np

from rig.camera import Camera, Distortion, Intrinsics
from rig.formats.cameras.cameras_json import write_rig
from rig.formats.cameras.colmap import write_colmap
from rig.formats.cameras.opencv_yaml import write_aniposelib, write_caliscope
from rig.geometry import look_at
from rig.rig import Rig

POINTS = np.random.default_rng(4).uniform(-80.0, 80.0, (20, 3))


def fan(count: int = 5) -> Rig:
    cameras = []
    for i, azimuth in enumerate(np.linspace(-1.2, 1.2, count)):
        centre = np.array([900 * np.sin(azimuth), 90.0 * i - 150, 900 * np.cos(azimuth)])
        lens = Distortion(-0.11 + 0.02 * i, 0.05, 1e-3 * i, -7e-4, 0.013)
        intrinsics = Intrinsics(1024 + i, 768, 1500.0 + i, 1510.0, 511.5 + i, 380.25, lens)
        cameras.append(Camera(f"cam{i:02d}", intrinsics, look_at(centre, np.zeros(3), np.array([0.0, 1.0, 0.0]))))
    return Rig(tuple(cameras))


def write(kind: str, rig: Rig, folder: Path) -> None:
    folder.mkdir(parents=True, exist_ok=True)
    match kind:
        case "ours":
            write_rig(rig, folder / "cameras.json")
        case "colmap text":
            write_colmap(rig, folder / "sparse" / "0")
        case "colmap binary":
            write_colmap(rig, folder, binary=True)
        case "caliscope":
            write_caliscope(rig, folder / "camera_array.toml")
        case "aniposelib":
            write_aniposelib(rig, folder / "calibration.toml")


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
    lenses = [replace(camera.intrinsics, fy=camera.intrinsics.fx) for camera in rig]
    return Rig(tuple(replace(c, intrinsics=lens) for c, lens in zip(rig, lenses, strict=True)))


OTHERS = ("metashape", "realitycapture", "realitycapture-csv", "nerfstudio", "opencv-yaml")
KINDS = ("ours", "colmap text", "colmap binary", "caliscope", "aniposelib")
