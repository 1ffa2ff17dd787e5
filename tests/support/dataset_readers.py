"""Readers of data sets of views, written from what other programs document of their formats, and dots to find again.

nerfstudio: https://docs.nerf.studio/quickstart/data_conventions.html (camera-to-world, OpenGL's axes; the centre of the
top-left pixel is half a pixel inside). GaussianAvatars: its loader takes the horizontal field of view and the size,
square pixels and a principal point in the middle.
"""

import json
import math
from pathlib import Path
from typing import Any

import cv2
import numpy as np
from scipy.optimize import least_squares

from rig.camera import Camera

DISC_PX, SIGMA_PX, WINDOW_PX = 10, 1.5, 5


def frames_of(folder: Path, file: str = "transforms.json") -> list[dict[str, Any]]:
    return json.loads((folder / file).read_text())["frames"]


def nerfstudio_pixel(frame: dict[str, Any], point_m: np.ndarray) -> np.ndarray:
    """Column and row of a world point, counted from the centre of the top-left pixel."""
    x, y, z, _ = np.linalg.inv(np.array(frame["transform_matrix"])) @ np.append(point_m, 1.0)
    assert z < 0  # it looks along -z
    assert not any(frame.get(key, 0.0) for key in ("k1", "k2", "k3", "k4", "p1", "p2"))
    right, down = x / -z, -y / -z
    return np.array([frame["fl_x"] * right + frame["cx"], frame["fl_y"] * down + frame["cy"]]) - 0.5


def avatar_pixel(frame: dict[str, Any], point_m: np.ndarray) -> np.ndarray:
    """The same from the field of view alone."""
    camera_to_world = np.array(frame["transform_matrix"])
    camera_to_world[:3, 1:3] = -camera_to_world[:3, 1:3]
    x, y, z, _ = np.linalg.inv(camera_to_world) @ np.append(point_m, 1.0)
    focal = 0.5 * frame["w"] / math.tan(0.5 * frame["camera_angle_x"])
    return np.array([focal * x / z + 0.5 * frame["w"], focal * y / z + 0.5 * frame["h"]]) - 0.5


def moments_of(folder: Path) -> dict[int, dict[str, np.ndarray]]:
    """FLAME parameters by moment, of the frames that name some, as GaussianAvatars' loader takes them: the first frame
    of a moment decides."""
    moments: dict[int, dict[str, np.ndarray]] = {}
    for frame in frames_of(folder, "transforms_train.json"):
        if "flame_param_path" in frame and frame["timestep_index"] not in moments:
            with np.load(folder / frame["flame_param_path"], allow_pickle=False) as file:
                moments[frame["timestep_index"]] = dict(file)
    return moments


def read_png(path: Path) -> np.ndarray:
    """Grey levels or RGB."""
    pixels = cv2.imread(str(path), cv2.IMREAD_UNCHANGED)
    assert pixels is not None, path
    return pixels[:, :, ::-1] if pixels.ndim == 3 else pixels


def with_dots(image: np.ndarray, camera: Camera, points_mm: np.ndarray) -> np.ndarray:
    """The picture with a soft bright dot on a black disc where the camera sees each point; dots are round without the
    lens's distortion."""
    drawn, k = image.copy(), camera.intrinsics
    columns, rows = np.meshgrid(np.arange(k.width, dtype=float), np.arange(k.height, dtype=float))
    straight = camera.undistort(np.stack([columns, rows], axis=-1).reshape(-1, 2)).reshape(*rows.shape, 2)
    places = camera.camera_from_world.apply(points_mm)
    for place in places[:, :2] / places[:, 2:]:
        squared = (((straight - place) * (k.fx, k.fy)) ** 2).sum(axis=2)
        dot = np.rint(240.0 * np.exp(-0.5 * squared / SIGMA_PX**2)).astype(np.uint8)
        drawn[squared < DISC_PX**2] = dot[squared < DISC_PX**2, None]
    return drawn


def dot_centre(picture: np.ndarray, near: np.ndarray) -> np.ndarray:
    """Column and row of the dot about ``near``: those of the Gaussian that is least squares of its grey levels."""
    column, row = np.rint(near).astype(int)
    window = np.s_[row - WINDOW_PX : row + WINDOW_PX + 1, column - WINDOW_PX : column + WINDOW_PX + 1]
    rows, columns = np.mgrid[window]
    levels = picture[window].astype(float).mean(axis=2)
    assert levels.max() > 150, "no dot there"

    def misfit(values: np.ndarray) -> np.ndarray:
        at_column, at_row, peak, sigma = values
        return (peak * np.exp(-0.5 * ((columns - at_column) ** 2 + (rows - at_row) ** 2) / sigma**2) - levels).ravel()

    return least_squares(misfit, [column, row, levels.max(), SIGMA_PX]).x[:2]
