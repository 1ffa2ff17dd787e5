"""Reads and writes cameras in ``transforms.json``, the format of nerfstudio and instant-ngp.

``transform_matrix`` is world_from_camera with OpenGL's axes (x right, y up, z backwards;
https://docs.nerf.studio/quickstart/data_conventions.html). The centre of the top-left pixel is (0.5, 0.5), as in
COLMAP. Intrinsics are at the top level or in a frame. Files from Blender state only ``camera_angle_x``, and the size
comes from the pictures. Lengths are in metres if all cameras lie within 30 units of each other, otherwise in
millimetres, after dividing by ``applied_scale``. If a file has several moments (``timestep_index``), only one is
read."""

import json
import math
from pathlib import Path
from typing import Any

import numpy as np

from rig.camera import Camera
from rig.errors import InputError
from rig.files import write_atomically
from rig.formats.cameras.cameras_json import is_number
from rig.formats.cameras.foreign import (
    CamerasRead,
    Reading,
    camera_entry,
    camera_names,
    lens_entry,
    matrix_intrinsics,
    millimetres_of,
    number_array,
    pose_matrix,
    shown,
    sized,
)
from rig.formats.cameras.foreign_keys import TRANSFORMS
from rig.messages.message import Message, compose
from rig.rig import Rig

OPENGL = np.diag([1.0, -1.0, -1.0])  # OpenCV's camera axes from OpenGL's
MODELS = {"PINHOLE": False, "SIMPLE_PINHOLE": False, "OPENCV": False, "OPENCV_FISHEYE": True}
LENS = ("k1", "k2", "k3", "k4", "p1", "p2")
PER_CAMERA = (*LENS, "k5", "k6", "rolling_shutter")  # keys at the top that hold for every camera


def read_transforms(document: Any, path: Path) -> CamerasRead:
    """Returns the rig in a decoded ``transforms.json``, a camera for each frame. Raises InputError naming every
    fault."""
    frames = document.get("frames") if isinstance(document, dict) else None
    if not isinstance(frames, list) or not all(isinstance(frame, dict) for frame in frames):
        raise InputError(path.name, [compose("no-frame-list")])
    reading = Reading(path.name)
    faults = reading.faults
    reading.judge(TRANSFORMS, {key: value for key, value in document.items() if key not in PER_CAMERA}, "")
    listed = camera_names([str(frame.get("file_path", f"frame{i:03}")) for i, frame in enumerate(frames)])
    names, frames = _frames_of_one_moment(document, listed, frames, reading)
    matrices = [
        pose_matrix(frame.get("transform_matrix"), f"{name}.transform_matrix", faults)
        for name, frame in zip(names, frames, strict=True)
    ]
    for name, frame in zip(names, frames, strict=True):
        lens = {key: value for key, value in document.items() if key in PER_CAMERA}
        reading.judge(TRANSFORMS, lens | frame, name)
    _check_applied(document.get("applied_transform"), faults)
    applied = _number(document.get("applied_scale", 1.0), "applied_scale", faults)
    if applied <= 0:
        faults.append(compose("no-positive-number", key="applied_scale", value=f"{applied:g}"))
    scale = 1.0 / applied if applied > 0 else 1.0
    millimetres = scale * millimetres_of([scale * matrix[:3, 3] for matrix in matrices])
    entries = [
        _entry(path.parent, name, document | frame, matrix, millimetres, faults)
        for name, frame, matrix in zip(names, frames, matrices, strict=True)
    ]
    return reading.finish(entries)


def _frames_of_one_moment(
    document: dict[str, Any], names: list[str], frames: list[dict[str, Any]], reading: Reading
) -> tuple[list[str], list[dict[str, Any]]]:
    """Returns the cameras and frames of one moment: the first in the file's ``timestep_indices`` or, without this list,
    of the first frame. Frames without a moment are always returned, and frames without a pose never."""
    posed = [k for k, frame in enumerate(frames) if frame.get("transform_matrix") is not None]
    for name in (name for k, name in enumerate(names) if k not in posed):
        reading.leave_out(name, compose("left-without-pose"))
    names, frames = [names[k] for k in posed], [frames[k] for k in posed]
    numbers = [frame.get("timestep_index") for frame in frames]
    moments = sorted({number for number in numbers if isinstance(number, int)})
    listed = document.get("timestep_indices")
    wanted = [one for one in listed if one in moments] if isinstance(listed, list) else []
    moment = [*wanted, *moments, 0][0]
    other = [isinstance(number, int) and number != moment for number in numbers]
    for name in (name for name, is_other in zip(names, other, strict=True) if is_other):
        reading.leave_out(name, compose("of-other-moment", moment=moment, moments=moments))
    kept = [k for k, is_other in enumerate(other) if not is_other]
    return [names[k] for k in kept], [frames[k] for k in kept]


def read_splatting(document: Any, path: Path) -> CamerasRead:
    """Returns the rig in Gaussian splatting's ``cameras.json``. The JSON holds world_from_camera with OpenCV's axes, in
    an arbitrary unit, of pinholes with a central principal point. Raises InputError naming every fault."""
    reading = Reading(path.name)
    faults, entries, names = reading.faults, [], camera_names([str(camera["img_name"]) for camera in document])
    centres = [number_array(camera["position"], (3,), "position", faults) for camera in document]
    millimetres = millimetres_of(centres)
    for name, camera, centre in zip(names, document, centres, strict=True):
        rotation = number_array(camera["rotation"], (3, 3), f"{name}.rotation", faults)
        width, height, fx = (_number(camera.get(key), f"{name}.{key}", faults) for key in ("width", "height", "fx"))
        fy = _number(camera.get("fy", fx), f"{name}.fy", faults)
        intrinsics = fx, fy, 0.5 * width - 0.5, 0.5 * height - 0.5
        translation = -rotation.T @ centre * millimetres
        entries.append(camera_entry(name, (width, height), intrinsics, {}, rotation.T, translation))
    return reading.finish(entries)


def read_nersemble(document: Any, path: Path) -> CamerasRead:
    """Returns the rig in NeRSemble's ``camera_params.json``. NeRSemble's file holds camera_from_world in metres with
    OpenCV's axes, and one camera matrix for all cameras. NeRSemble's image size is read from the pictures. Raises
    InputError naming every fault."""
    reading = Reading(path.name)
    faults, poses = reading.faults, document["world_2_cam"]
    if not isinstance(poses, dict):
        raise InputError(path.name, [compose("no-object", key="world_2_cam")])
    intrinsics = matrix_intrinsics(number_array(document.get("intrinsics"), (3, 3), "intrinsics", faults))
    entries = []
    for name, value in poses.items():
        pose = pose_matrix(value, f"world_2_cam.{name}", faults)
        size = sized(path.parent, name, faults)
        entries.append(camera_entry(name, size, intrinsics, {}, pose[:, :3], 1000.0 * pose[:, 3]))
    return reading.finish(entries)


def write_transforms(rig: Rig, path: Path) -> None:
    """Writes ``transforms.json`` in metres, with the picture paths ``images/<camera>.png``."""
    frames = [frame_document(camera, f"images/{camera.name}.png") for camera in rig]
    write_atomically(path, json.dumps({"camera_model": "OPENCV", "frames": frames}, indent=1).encode())


def frame_document(camera: Camera, file_path: str) -> dict[str, object]:
    """Returns one camera's entry of ``transforms.json``, in metres. Raises InputError for an unsupported lens."""
    return {"file_path": file_path, **_lens(camera), "transform_matrix": opengl_pose(camera)}


def opengl_pose(camera: Camera) -> list[list[float]]:
    """Returns world_from_camera as a 4 x 4 matrix in metres, with OpenGL's camera axes."""
    matrix = np.eye(4)
    pose = camera.camera_from_world.inverse()
    matrix[:3, :3], matrix[:3, 3] = pose.rotation @ OPENGL, pose.translation / 1000.0
    return matrix.tolist()


def _lens(camera: Camera) -> dict[str, object]:
    k, d, lens = camera.intrinsics, camera.intrinsics.distortion, camera.recorded
    entry: dict[str, object] = {"w": k.width, "h": k.height, "fl_x": k.fx, "fl_y": k.fy}
    entry |= {"cx": k.cx + 0.5, "cy": k.cy + 0.5}
    if lens is None:
        return entry | {"k1": d.k1, "k2": d.k2, "k3": d.k3, "p1": d.p1, "p2": d.p2}
    if lens.model == "rational":
        raise InputError("nerfstudio", [compose("format-without-lens", cameras=[camera.name])])
    return entry | {"camera_model": "OPENCV_FISHEYE", **dict(zip(LENS[:4], lens.coefficients, strict=True))}


def _entry(
    folder: Path, name: str, values: dict[str, Any], matrix: np.ndarray, millimetres: float, faults: list[Message]
) -> dict[str, object]:
    fisheye = _is_fisheye(values, name, faults)
    size = values.get("w"), values.get("h")
    if None in size:
        size = sized(folder, name, faults)
    width, height = (_number(value, f"{name}.{key}", faults) for value, key in zip(size, ("w", "h"), strict=True))
    fx = _focal(values, "x", width, None, name, faults)
    fy = _focal(values, "y", height, fx, name, faults)
    cx = _number(values.get("cx", 0.5 * width), f"{name}.cx", faults)
    cy = _number(values.get("cy", 0.5 * height), f"{name}.cy", faults)
    lens = {key: _number(values.get(key, 0.0), f"{name}.{key}", faults) for key in LENS}
    if not fisheye and lens["k4"]:
        faults.append(compose("k4-of-no-fisheye", key=f"{name}.k4"))
        lens["k4"] = 0.0
    pose = (matrix[:3, :3] @ OPENGL).T
    found = lens_entry(lens, name, faults, fisheye=fisheye)
    translation = -pose @ (millimetres * matrix[:3, 3])
    return camera_entry(name, (width, height), (fx, fy, cx - 0.5, cy - 0.5), found, pose, translation)


def _is_fisheye(values: dict[str, Any], name: str, faults: list[Message]) -> bool:
    """Returns whether the lens model is Kannala-Brandt, from nerfstudio's ``camera_model`` or instant-ngp's
    ``is_fisheye``."""
    model, flag = values.get("camera_model"), values.get("is_fisheye", False)
    if not (model is None or (isinstance(model, str) and model in MODELS)):
        faults.append(compose("value-not-read", key=f"{name}.camera_model", value=shown(model), known=[*MODELS]))
        return False
    if not isinstance(flag, bool) and flag not in (0, 1):
        faults.append(compose("no-switch", key=f"{name}.is_fisheye", value=shown(flag)))
        return False
    if flag and model is not None and not MODELS[model]:
        faults.append(compose("fisheye-or-not", key=f"{name}.is_fisheye", model=model))
    return bool(flag) or (model is not None and MODELS[model])


def _check_applied(value: object, faults: list[Message]) -> None:
    """Appends a fault if ``applied_transform`` scales or mirrors the scene.

    A rotation by ``applied_transform`` is accepted and not undone, because the world frame is arbitrary."""
    if value is None:
        return
    try:
        matrix = np.array(value, dtype=float)[:3, :3]
    except (TypeError, ValueError, IndexError):
        matrix = np.zeros(0)
    if matrix.shape != (3, 3) or not np.isfinite(matrix).all():
        faults.append(compose("applied-transform-shape", value=shown(value)))
    elif np.abs(matrix @ matrix.T - np.eye(3)).max() > 1e-3 or np.linalg.det(matrix) < 0:
        faults.append(compose("applied-transform-scales"))


def _focal(
    values: dict[str, Any], axis: str, pixels: float, default: float | None, name: str, faults: list[Message]
) -> float:
    if (focal := values.get(f"fl_{axis}")) is not None:
        return _number(focal, f"{name}.fl_{axis}", faults)
    angle = values.get(f"camera_angle_{axis}")
    if angle is None:
        if default is None:
            faults.append(compose("focal-length-missing", camera=name, axis=axis))
        return math.nan if default is None else default
    angle = _number(angle, f"{name}.camera_angle_{axis}", faults)
    return 0.5 * pixels / math.tan(0.5 * angle) if 0 < angle < math.pi else math.nan


def _number(value: object, where: str, faults: list[Message]) -> float:
    if is_number(value):
        return float(value)  # type: ignore[arg-type]
    faults.append(compose("no-finite-number", key=where, value=shown(value)))
    return math.nan
