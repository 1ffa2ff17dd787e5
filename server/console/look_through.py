"""Lets a browser show a head through a camera of the rig: the camera's pose in the head's frame, and its photograph
without lens distortion, onto which a pinhole camera draws the mesh exactly."""

from pathlib import Path
from typing import TypedDict

import cv2
import numpy as np

from pipeline.results.report_types import Report
from rig.camera import Camera
from rig.errors import InputError
from rig.formats.cameras.cameras_file import find_rig_file, read_rig_file
from rig.geometry import RigidTransform
from rig.image import ImageRgb
from rig.messages.message import compose
from rig.rig import Rig
from server.storage.face_cache import FoundFace

WIDTH_MOST = 1600
MM = 1000.0


class CameraView(TypedDict):
    """Holds a pinhole camera (px). ``camera_from_head``: rows of a 4 x 4 matrix (metres); the head frame is that of
    head.glb."""

    name: str
    width: int
    height: int
    fx: float
    fy: float
    cx: float
    cy: float
    camera_from_head: list[list[float]]


def camera_views(rig: Rig, report: Report) -> list[CameraView]:
    """Returns every camera of a capture as seen from the head. The head's pose is that of ``report``, its size the true
    one: x_world = R x_head + s t."""
    place = report["world_from_head"]
    shift = np.array(place["translation"]) * place["scale"]
    world_from_head = RigidTransform(np.array(place["rotation"]), shift)
    return [_view(camera, camera.camera_from_world @ world_from_head) for camera in rig]


def rig_of(capture: Path) -> Rig:
    """Reads the rig from the files of a capture. Raises InputError if there is none or it cannot be read."""
    found = find_rig_file(capture)
    if found is None:
        raise InputError("capture", [compose("no-cameras-json")])
    return read_rig_file(found)


def straightened(image: ImageRgb, camera: Camera) -> ImageRgb:
    """Removes the lens's distortion from a photograph and reduces it to at most ``WIDTH_MOST`` pixels of width."""
    lens = camera.intrinsics
    if camera.recorded is not None:
        image = camera.recorded.undistort(image, lens.matrix(), smooth=True)
    factor = min(1.0, WIDTH_MOST / lens.width)
    size = (round(lens.width * factor), round(lens.height * factor))
    wanted = np.diag([factor, factor, 1.0]) @ lens.matrix()
    wanted[:2, 2] += (factor - 1) / 2  # the centre of the first pixel stays 0
    columns, rows = cv2.initUndistortRectifyMap(
        lens.matrix(), lens.distortion.opencv(), np.eye(3), wanted, size, cv2.CV_32FC1
    )
    return np.asarray(cv2.remap(image, columns, rows, cv2.INTER_AREA), np.uint8)


def straightened_face(face: FoundFace, camera: Camera) -> FoundFace:
    """Converts a face to the pixels of the photograph without distortion, at full size. Points outside the lens are
    left out."""
    lens, pixels = camera.intrinsics, np.array(face["points"])
    if camera.recorded is not None:
        straight = camera.recorded.undistorted(pixels, lens.matrix())
    else:
        straight = camera.undistort(pixels) * (lens.fx, lens.fy) + (lens.cx, lens.cy)
    straight = straight[np.isfinite(straight).all(axis=1)].round(1)
    box = [*straight.min(axis=0), *straight.max(axis=0)] if len(straight) else face["box_px"]
    return {**face, "box_px": [float(side) for side in box], "points": straight.tolist()}


def _view(camera: Camera, camera_from_head: RigidTransform) -> CameraView:
    lens, matrix = camera.intrinsics, np.eye(4)
    matrix[:3, :3], matrix[:3, 3] = camera_from_head.rotation, camera_from_head.translation / MM
    return {
        "name": camera.name,
        "width": lens.width,
        "height": lens.height,
        "fx": lens.fx,
        "fy": lens.fy,
        "cx": lens.cx,
        "cy": lens.cy,
        "camera_from_head": matrix.tolist(),
    }
