"""Reads and writes caliscope's ``camera_array.toml`` (metres; https://mprib.github.io/caliscope) and aniposelib's TOML
(in the unit of its board, see ``_aniposelib_unit``; https://anipose.readthedocs.io). Both use OpenCV's pixels, so
nothing is shifted."""

import json
import tomllib
from collections.abc import Mapping
from pathlib import Path
from typing import Any

import numpy as np
from jaxtyping import Float

from rig.atomic_write import write_atomically
from rig.camera import Camera
from rig.errors import InputError
from rig.formats.cameras.foreign import (
    camera_entry,
    lens_entry,
    matrix_intrinsics,
    matrix_skew,
    millimetres_of,
    number_array,
    parsed,
    pose_rotation,
)
from rig.formats.cameras.foreign_keys import ANIPOSELIB, CALISCOPE
from rig.formats.cameras.reading import CamerasRead, Reading, shown
from rig.geometry import vector_from_rotation
from rig.messages.message import Message, compose
from rig.recorded_lens import COEFFICIENTS
from rig.rig import Rig

UNITS = {"mm": 1.0, "cm": 10.0, "m": 1000.0}  # millimetres in each


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
    """Writes ``camera_array.toml``: metres, cameras numbered in the rig's order, names kept beside the numbers."""
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
    """Writes an aniposelib calibration, in millimetres (which ``metadata`` says)."""
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
    """Returns a truth value; an absent one is false."""
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

    ``metadata.unit`` states it. Without it the size of the rig decides, since aniposelib takes over the unit of the
    board: cameras within 30 units of each other are in metres."""
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
    """Returns the place of a camera; NaN where its pose is none."""
    translation = number_array(table.get("translation"), (3,), "", [])
    rotation = pose_rotation(number_array(table.get("rotation"), None, "", []))
    return -rotation.T @ translation if rotation.shape == (3, 3) else np.full(3, np.nan)


def looks_like_aniposelib(path: Path) -> bool:
    """Tells whether a TOML file consists of aniposelib's camera tables."""
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
