"""Photographs of a wedge of two textured planes, drawn ray by ray: an oracle that shares no projection with COLMAP.

The ray of pixel (u, v) goes through its centre, ``((u - cx) / fx, (v - cy) / fy, 1)`` in the camera: nothing but the
project's convention. World frame in mm, the ridge along y at x = 0, its sides falling away from z = 0.
"""

import json
from collections.abc import Mapping, Sequence
from functools import cache
from pathlib import Path
from tempfile import TemporaryDirectory

import cv2
import numpy as np
from jaxtyping import Float, UInt8

from calibration.scene.result import SceneCalibration
from calibration.scene.scene import calibrate_scene
from rig.camera import Camera, Intrinsics
from rig.formats.pictures.images import write_image
from rig.geometry import RigidTransform, look_at
from rig.rig import Rig

WIDTH, HEIGHT, FOCAL_PX = 400, 300, 460.0
SLOPE = 0.6  # of the sides
SIDE_MM, TEXELS_MM = 300.0, 2.0  # of the texture, of both planes together
TAG_MM, TAG_NUMBER, TAG_CORNER_MM = 40.0, 7, (30.0, -60.0)  # printed on the right side, along it, and along y
AZIMUTHS_DEG = (-24.0, -12.0, 0.0, 12.0, 24.0, 6.0)
ROLLS_DEG = (0.0, 4.0, -3.0, 90.0, 0.0, 180.0)  # cameras on their side tell half a pixel: a common shift would show


def wedge_rig(azimuths_deg: Sequence[float] = AZIMUTHS_DEG, focal_px: float = FOCAL_PX) -> Rig:
    """Cameras of one lens on an arc, 420 mm from the ridge, some of them rolled."""
    intrinsics = Intrinsics(WIDTH, HEIGHT, focal_px, focal_px, (WIDTH - 1) / 2, (HEIGHT - 1) / 2)
    cameras = []
    for index, azimuth in enumerate(np.radians(azimuths_deg)):
        elevation = np.radians(8.0 * (-1) ** index)
        centre = 420.0 * np.array([np.sin(azimuth), np.sin(elevation), np.cos(azimuth)])
        upright = look_at(centre, np.array([3.0 * index, 0.0, -20.0]), np.array([0.0, 1.0, 0.0]))
        roll = np.radians(ROLLS_DEG[index % len(ROLLS_DEG)])
        turn = np.array([[np.cos(roll), -np.sin(roll), 0.0], [np.sin(roll), np.cos(roll), 0.0], [0.0, 0.0, 1.0]])
        cameras.append(Camera(f"cam{index:02}", intrinsics, RigidTransform(turn, np.zeros(3)) @ upright))
    return Rig(tuple(cameras))


def on_wedge(camera: Camera, pixels: Float[np.ndarray, "n 2"]) -> Float[np.ndarray, "n 3"]:
    """Where the rays of ``pixels`` meet the wedge, mm."""
    k = camera.intrinsics
    inside = np.column_stack([(pixels[:, 0] - k.cx) / k.fx, (pixels[:, 1] - k.cy) / k.fy, np.ones(len(pixels))])
    rays = inside @ camera.camera_from_world.rotation
    centre = camera.centre_world
    hits = []
    for side in (1.0, -1.0):  # z = -SLOPE * side * x
        normal = np.array([SLOPE * side, 0.0, 1.0])
        hits.append(centre - rays * ((centre @ normal) / (rays @ normal))[:, None])
    return np.where(hits[0][:, :1] > 0, hits[0], hits[1])


def photograph(camera: Camera, seed: int = 0) -> UInt8[np.ndarray, "h w"]:
    """What ``camera`` sees."""
    k = camera.intrinsics
    u, v = np.meshgrid(np.arange(k.width, dtype=float), np.arange(k.height, dtype=float))
    points = on_wedge(camera, np.column_stack([u.ravel(), v.ravel()]))
    along = points[:, 0] * np.sqrt(1 + SLOPE**2)  # mm along the side, from the ridge
    # Rows of the texture go down: a tag that is printed upside down in a mirror is none.
    across, down = (
        (TEXELS_MM * (c + SIDE_MM / 2)).reshape(k.height, k.width).astype(np.float32) for c in (along, -points[:, 1])
    )
    grey = (128.0,)
    return cv2.remap(texture(seed), across, down, cv2.INTER_LINEAR, None, cv2.BORDER_CONSTANT, grey)


@cache
def texture(seed: int) -> UInt8[np.ndarray, "s s"]:
    """Blobs of several sizes, and a printed tag."""
    size = int(SIDE_MM * TEXELS_MM)
    rng = np.random.default_rng(seed)
    image = np.zeros((size, size))
    for blur_mm, weight in ((3.0, 1.0), (6.0, 1.0), (12.0, 0.7)):
        layer = cv2.GaussianBlur(rng.normal(size=(size, size)), (0, 0), blur_mm * TEXELS_MM / 2)
        image += weight * layer / layer.std()
    pixels = np.clip(128 + 45 * image, 0, 255).astype(np.uint8)
    dictionary = cv2.aruco.getPredefinedDictionary(cv2.aruco.DICT_4X4_50)
    tag = cv2.aruco.generateImageMarker(dictionary, TAG_NUMBER, int(TAG_MM * TEXELS_MM))
    left, top = (int(TEXELS_MM * (c + SIDE_MM / 2)) for c in TAG_CORNER_MM)
    rim = int(5 * TEXELS_MM)
    pixels[top - rim : top + len(tag) + rim, left - rim : left + len(tag) + rim] = 255
    pixels[top : top + len(tag), left : left + len(tag)] = tag
    return pixels


def write_photographs(folder: Path, rig: Rig, shots: Mapping[str, int] | None = None) -> Path:
    """One picture a camera; or, with ``shots``, a folder a camera of one picture a shot, of another wedge each (the
    seeds of their textures)."""
    for camera in rig:
        if shots is None:
            write_image(folder / f"{camera.name}.png", photograph(camera))
        for shot, seed in (shots or {}).items():
            write_image(folder / camera.name / f"{shot}.png", photograph(camera, seed))
    return folder


@cache
def solved() -> SceneCalibration:
    """The wedge as ``solve`` calibrates it, once a session."""
    return solve()


def solve() -> SceneCalibration:
    """The wedge calibrated from its photographs, its scale from the tag."""
    with TemporaryDirectory() as folder:
        photos = write_photographs(Path(folder) / "photos", wedge_rig())
        scale = Path(folder) / "scale.json"
        scale.write_text(json.dumps({"tag": {"dictionary": "DICT_4X4_50", "size_mm": TAG_MM}}))
        return calibrate_scene(photos, scale=scale, front="cam02")
