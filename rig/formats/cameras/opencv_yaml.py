"""Reads and writes cameras in OpenCV's YAML format, with the keys of EasyMocap
(https://chingswy.github.io/easymocap-public-doc).

The file ``intri.yml`` contains ``names``, ``K_<name>`` and ``dist_<name>``. The file ``extri.yml`` contains
camera_from_world as ``T_<name>`` and ``Rot_<name>`` (or ``R_<name>``, a rotation vector). One file of another name may
contain the keys of ``intri.yml`` and ``extri.yml``. Lengths are in metres if all cameras lie within 30 units of each
other, otherwise in millimetres. If the size keys ``W_<name>`` and ``H_<name>`` are missing, pictures give the size.

The module also reads and writes two TOML formats: caliscope's ``camera_array.toml`` (metres;
https://mprib.github.io/caliscope) and aniposelib's (in the unit of the board; https://anipose.readthedocs.io). The
module's formats have OpenCV's pixel centres, so no principal point is shifted."""

import json
import re
import tomllib
from collections.abc import Callable, Mapping, Sequence
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np
from jaxtyping import Float

from rig.camera import Camera
from rig.errors import InputError
from rig.files import write_atomically
from rig.formats.cameras.foreign import (
    CamerasRead,
    Malformed,
    Reading,
    camera_entry,
    lens_entry,
    matrix_intrinsics,
    matrix_skew,
    millimetres_of,
    number_array,
    parsed,
    pose_rotation,
    shown,
    sized,
)
from rig.formats.cameras.foreign_keys import ANIPOSELIB, CALISCOPE, OPENCV_YAML
from rig.formats.pictures.picture_names import entry
from rig.geometry import vector_from_rotation
from rig.messages.message import Message, compose, some_of
from rig.recorded_lens import COEFFICIENTS
from rig.rig import Rig

UNITS = {"mm": 1.0, "cm": 10.0, "m": 1000.0}  # millimetres in each
if TYPE_CHECKING:
    import cv2

FILES = ("intri.yml", "extri.yml")
POSE_KEY = re.compile(r"(R|Rot|T)_")


def read_yaml(path: Path) -> CamerasRead:
    """Returns the rig in ``intri.yml`` and ``extri.yml`` of one folder, or in the single file ``path``. Raises
    InputError naming every fault."""
    parts = [entry(path.parent, name) for name in FILES] if path.name.lower() in FILES else [path, path]
    lenses, poses = (parsed(part, _matrices) for part in parts)
    held = [key.removeprefix("K_") for key in lenses if key.startswith("K_")]
    if not held:
        raise InputError(path.name, [compose("yaml-without-camera")])
    reading = Reading(path.name)
    faults = reading.faults
    listed = _taking_part(held, [*lenses["names"]] if isinstance(lenses.get("names"), list) else None, reading)
    for name in listed:
        if not {f"R_{name}", f"Rot_{name}", f"T_{name}"} & poses.keys():
            reading.leave_out(name, compose("left-without-pose"))
    names = [name for name in listed if name not in reading.left_out]
    _judge(lenses | poses, held, reading)
    lacking = [key for key in poses if (m := POSE_KEY.match(key)) and key[m.end() :] not in held]
    if lacking:
        faults.append(compose("yaml-pose-alone", keys=some_of(lacking)))
    read: list[tuple[Any, ...]] = []
    for name in names:
        matrix = number_array(lenses[f"K_{name}"], (3, 3), f"K_{name}", faults)
        lens = number_array(lenses.get(f"dist_{name}", np.zeros(5)), None, f"dist_{name}", faults).ravel()
        keys = COEFFICIENTS["rational"]
        if lens[len(keys) :].any():
            faults.append(compose("coefficients-many", key=f"dist_{name}", most=len(keys), names=" ".join(keys)))
        turned = poses.get(f"Rot_{name}", pose_rotation(_array(poses, f"R_{name}")))
        rotation = number_array(turned, (3, 3), f"Rot_{name}", faults)
        _check_alike(poses, name, faults)
        translation = number_array(_array(poses, f"T_{name}").ravel(), (3,), f"T_{name}", faults)
        if f"W_{name}" in lenses and f"H_{name}" in lenses:
            sides = [number_array(_array(lenses, f"{s}_{name}").ravel(), (1,), f"{s}_{name}", faults) for s in "WH"]
            size = float(sides[0][0]), float(sides[1][0])
        else:
            size = sized(path.parent, name, faults)
        held_lens = lens_entry(dict(zip(keys, lens.tolist(), strict=False)), name, faults, skew=matrix_skew(matrix))
        read.append((name, size, matrix_intrinsics(matrix), held_lens, rotation, translation))
    millimetres = millimetres_of([-rotation.T @ translation for *_, rotation, translation in read])
    return reading.finish([camera_entry(n, s, k, lens, r, millimetres * t) for n, s, k, lens, r, t in read])


def _taking_part(held: list[str], listed: list[str] | None, reading: Reading) -> list[str]:
    """Returns the cameras that the file's list ``names`` contains, or all cameras without such a list. Appends a fault
    if the file lacks a camera of ``names``."""
    if not listed:
        return held
    lacking = [name for name in listed if name not in held]
    if lacking:
        reading.faults.append(compose("yaml-names-lacking", cameras=some_of(lacking)))
    for name in held:
        if name not in listed:
            reading.leave_out(name, compose("left-not-named"))
    return [name for name in held if name in listed]


def _judge(values: Mapping[str, object], held: Sequence[str], reading: Reading) -> None:
    """Checks every key of the file against the table of keys."""
    for key, value in values.items():
        name = next((name for name in sorted(held, key=len, reverse=True) if key.endswith(f"_{name}")), "")
        general = key.removesuffix(name) + "<name>" if name else key
        if name or key == "names" or not POSE_KEY.match(key):
            plain = value.ravel().tolist() if isinstance(value, np.ndarray) else value
            reading.judge(OPENCV_YAML, {general: plain}, name)


def _check_alike(poses: Mapping[str, Any], name: str, faults: list[Message]) -> None:
    """Appends a fault if a camera has a rotation vector and a different rotation matrix."""
    vector, matrix = _array(poses, f"R_{name}"), _array(poses, f"Rot_{name}")
    if vector.size not in (3, 9) or matrix.shape != (3, 3):
        return
    if not np.abs(pose_rotation(vector).reshape(3, 3) - matrix).max() < 1e-3:
        faults.append(compose("rotations-differ", one=f"R_{name}", other=f"Rot_{name}"))


def write_yaml(rig: Rig, folder: Path) -> None:
    """Writes ``intri.yml`` and ``extri.yml`` to a folder. Raises InputError for a fisheye lens."""
    fisheyes = [c.name for c in rig if c.recorded is not None and c.recorded.model == "kannala-brandt"]
    if fisheyes:
        raise InputError("opencv-yaml", [compose("yaml-fisheye", cameras=fisheyes)])

    import cv2  # here and below: other formats do without its 0.1 s

    def lenses(file: "cv2.FileStorage") -> None:
        for camera in rig:
            k, lens = camera.intrinsics, camera.recorded
            file.write(f"K_{camera.name}", k.matrix())
            file.write(f"dist_{camera.name}", np.array([k.distortion.opencv() if lens is None else lens.coefficients]))
            file.write(f"W_{camera.name}", k.width)
            file.write(f"H_{camera.name}", k.height)

    def poses(file: "cv2.FileStorage") -> None:
        for camera in rig:
            pose = camera.camera_from_world
            file.write(f"R_{camera.name}", cv2.Rodrigues(pose.rotation)[0])
            file.write(f"Rot_{camera.name}", pose.rotation)
            file.write(f"T_{camera.name}", pose.translation[:, None] / 1000.0)

    for name, fill in zip(FILES, (lenses, poses), strict=True):
        write_atomically(folder / name, _written(rig, fill))


def _written(rig: Rig, fill: "Callable[[cv2.FileStorage], None]") -> bytes:
    import cv2

    file = cv2.FileStorage(".yml", cv2.FILE_STORAGE_WRITE | cv2.FILE_STORAGE_MEMORY)
    file.startWriteStruct("names", cv2.FILE_NODE_SEQ)
    for camera in rig:
        file.write("", camera.name)
    file.endWriteStruct()
    fill(file)
    return file.releaseAndGetString().encode()


def _matrices(data: bytes) -> dict[str, Any]:
    """Returns all matrices, numbers and lists of words in a file by key. Raises ValueError for damaged YAML."""
    import cv2

    try:
        file = cv2.FileStorage(data.decode(), cv2.FILE_STORAGE_READ | cv2.FILE_STORAGE_MEMORY)
        root = file.root()
        found: dict[str, Any] = {}
        for key in root.keys():  # noqa: SIM118 a FileNode is no mapping
            node = root.getNode(key)
            if node.isMap():
                found[key] = np.asarray(node.mat(), float)
            elif node.isReal() or node.isInt():
                found[key] = np.array([node.real()])
            elif node.isSeq():
                found[key] = _listed(node)
            elif node.isString():
                found[key] = node.string()
        return found
    except (cv2.error, SystemError, TypeError) as error:
        said = " ".join(str(error).split())[:120]
        raise Malformed(compose("no-opencv-yaml", reason=said)) from None


def _listed(node: "cv2.FileNode") -> list[str] | Float[np.ndarray, "..."]:
    """Returns a list of words, or an array of numbers, which is empty if the rows differ in length."""
    entries = [node.at(i) for i in range(node.size())]
    if any(entry.isString() for entry in entries):
        return [entry.string() for entry in entries if entry.isString()]
    try:
        return np.array([_listed(entry) if entry.isSeq() else entry.real() for entry in entries], float)
    except ValueError:
        return np.zeros(0)


def _array(values: Mapping[str, Any], key: str) -> Float[np.ndarray, "..."]:
    """Returns the numbers under a key, or an empty array if they are missing."""
    value = values.get(key)
    return value if isinstance(value, np.ndarray) else np.zeros(0)


def read_toml(path: Path) -> CamerasRead:
    """Returns the rig in caliscope's ``camera_array.toml`` or in an aniposelib calibration. Raises InputError naming
    every fault."""
    document = parsed(path, lambda data: tomllib.loads(data.decode()))
    tables, reading = document.get("cameras"), Reading(path.name)
    if isinstance(tables, dict):
        pairs, keys = [(f"cam_{key}", table) for key, table in tables.items()], CALISCOPE
        millimetres = 1000.0
        reading.judge(CALISCOPE, {key: value for key, value in document.items() if key != "cameras"}, "")
    else:
        pairs, keys = [(key, table) for key, table in document.items() if key != "metadata"], ANIPOSELIB
        millimetres = _aniposelib_unit(document, pairs, reading)
    entries = []
    for name, table in pairs:
        if not isinstance(table, dict):
            reading.faults.append(compose("no-table", key=name))
            continue
        camera = table["name"] if isinstance(table.get("name"), str) else name
        if "ignore" in keys and _switch(table, "ignore", camera, reading.faults):
            reading.leave_out(camera, compose("left-switched-off", key="ignore = true"))
        elif not {"rotation", "translation"} & table.keys():
            reading.leave_out(camera, compose("left-without-pose"))
        else:
            reading.judge(keys, table, camera)
            entries.append(_toml_entry(camera, table, millimetres, reading.faults))
    return reading.finish(entries)


def write_caliscope(rig: Rig, path: Path) -> None:
    """Writes ``camera_array.toml`` in metres, with cameras numbered in the rig's order."""
    blocks = []
    for number, camera in enumerate(rig):
        keys: dict[str, object] = {
            "cam_id": number,
            "name": camera.name,
            "rotation_count": 0,
            "ignore": False,
            "fisheye": camera.recorded is not None and camera.recorded.model == "kannala-brandt",
        }
        keys |= _toml_intrinsics(camera)
        keys["rotation"] = camera.camera_from_world.rotation.tolist()
        keys["translation"] = (camera.camera_from_world.translation / 1000.0).tolist()
        blocks.append(_toml_block(f"cameras.{number}", keys))
    write_atomically(path, "\n".join(blocks).encode())


def write_aniposelib(rig: Rig, path: Path) -> None:
    """Writes an aniposelib calibration in millimetres."""
    blocks = []
    for number, camera in enumerate(rig):
        keys: dict[str, object] = {"name": camera.name, **_toml_intrinsics(camera)}
        if camera.recorded is not None and camera.recorded.model == "kannala-brandt":
            keys["fisheye"] = True
        keys["rotation"] = vector_from_rotation(camera.camera_from_world.rotation).tolist()
        keys["translation"] = camera.camera_from_world.translation.tolist()
        blocks.append(_toml_block(f"cam_{number}", keys))
    blocks.append(_toml_block("metadata", {"unit": "mm"}))
    write_atomically(path, "\n".join(blocks).encode())


def _switch(table: Mapping[str, Any], key: str, name: str, faults: list[Message]) -> bool:
    """Returns a Boolean value of a table, or False if the key is missing."""
    value = table.get(key, False)
    if not isinstance(value, bool) and value not in (0, 1):
        faults.append(compose("no-switch", key=f"{name}.{key}", value=shown(value)))
    return value is True or value == 1


def _toml_entry(name: str, table: Mapping[str, Any], millimetres: float, faults: list[Message]) -> dict[str, object]:
    fisheye = _switch(table, "fisheye", name, faults)
    matrix = number_array(table.get("matrix"), (3, 3), f"{name}.matrix", faults)
    rotation = number_array(table.get("rotation"), None, f"{name}.rotation", faults)
    translation = number_array(table.get("translation"), (3,), f"{name}.translation", faults)
    lens = number_array(table.get("distortions", [0.0] * 4), None, f"{name}.distortions", faults)
    names = COEFFICIENTS["kannala-brandt" if fisheye else "rational"]
    if lens.ndim != 1 or not 1 <= len(lens) <= 14 or lens[len(names) :].any():
        list_key = f"{name}.distortions"
        faults.append(compose("coefficients-at-most", key=list_key, most=len(names), names=" ".join(names)))
    coefficients = dict(zip(names, lens.ravel().tolist(), strict=False))
    size = table.get("size")
    width, height = size if isinstance(size, list) and len(size) == 2 else (None, None)
    found = lens_entry(coefficients, name, faults, fisheye=fisheye, skew=matrix_skew(matrix))
    translation = millimetres * translation
    return camera_entry(name, (width, height), matrix_intrinsics(matrix), found, pose_rotation(rotation), translation)


def _aniposelib_unit(document: Mapping[str, object], pairs: list[tuple[str, Any]], reading: Reading) -> float:
    """Returns how many millimetres the unit of an aniposelib file has.

    The key ``metadata.unit`` states the unit. Without ``metadata.unit``, cameras within 30 units of each other are
    taken to be in metres, because aniposelib uses the unit of the board."""
    metadata = document.get("metadata")
    unit = metadata.get("unit") if isinstance(metadata, dict) else None
    if isinstance(metadata, dict):
        reading.judge(ANIPOSELIB, metadata, "", place="metadata.")
    if isinstance(unit, str) and unit in UNITS:
        return UNITS[unit]
    if unit is not None:
        reading.faults.append(compose("value-not-read", key="metadata.unit", value=shown(unit), known=[*UNITS]))
    return millimetres_of([_centre(table) for _, table in pairs if isinstance(table, dict)])


def _centre(table: Mapping[str, Any]) -> Float[np.ndarray, " 3"]:
    """Returns the position of a camera in the file's unit, or NaN if the camera's pose is invalid."""
    translation = number_array(table.get("translation"), (3,), "", [])
    rotation = pose_rotation(number_array(table.get("rotation"), None, "", []))
    return -rotation.T @ translation if rotation.shape == (3, 3) else np.full(3, np.nan)


def looks_like_aniposelib(path: Path) -> bool:
    """Returns whether a TOML file consists of camera tables with aniposelib's keys."""
    try:
        document = parsed(path, lambda data: tomllib.loads(data.decode()))
    except InputError:
        return False
    tables = [table for key, table in document.items() if key != "metadata" and isinstance(table, dict)]
    posed = [table for table in tables if {"rotation", "translation"} <= table.keys()]
    return bool(posed) and all("matrix" in table for table in tables)


def _toml_intrinsics(camera: Camera) -> dict[str, list]:
    k = camera.intrinsics
    return {
        "size": [k.width, k.height],
        "matrix": k.matrix().tolist(),
        "distortions": k.distortion.opencv().tolist()
        if camera.recorded is None
        else list(camera.recorded.coefficients),
    }


def _toml_block(title: str, keys: Mapping[str, object]) -> str:
    # Strings, booleans, numbers and nested lists of them read the same in JSON and TOML.
    return "\n".join([f"[{title}]", *(f"{key} = {json.dumps(value)}" for key, value in keys.items()), ""])
