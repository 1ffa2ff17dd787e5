"""Caliscope's ``camera_array.toml`` (metres; https://mprib.github.io/caliscope) and aniposelib's TOML (the unit of its
board, see
``_aniposelib_unit``; https://anipose.readthedocs.io). Both follow OpenCV's pixels and need no shift."""

import json
import tomllib
from collections.abc import Mapping
from pathlib import Path
from typing import Any

import numpy as np

from rig.atomic_write import write_atomically
from rig.camera import Camera
from rig.errors import InputError
from rig.formats.foreign import MATRIX_PLACES, METRES_MOST, judged_rig, lens_entry, number_array, parsed
from rig.geometry import rotation_from_vector, vector_from_rotation
from rig.recorded_lens import COEFFICIENTS
from rig.rig import Rig


def read_toml(path: Path) -> Rig:
    """The rig in caliscope's ``camera_array.toml`` or in an aniposelib calibration."""
    document = parsed(path, lambda data: tomllib.loads(data.decode("utf-8-sig")))
    tables = document.get("cameras")
    if isinstance(tables, dict):
        pairs = [(f"cam_{key}", table) for key, table in tables.items()]
        millimetres = 1000.0
    else:
        pairs = [(key, table) for key, table in document.items() if key != "metadata"]
        millimetres = _aniposelib_unit(document, pairs)
    faults: list[str] = []
    entries = [
        _toml_entry(name, table, millimetres, faults)
        for name, table in pairs
        if not (isinstance(table, dict) and table.get("ignore") is True)
    ]
    return judged_rig(entries, path.name, faults)


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


def _toml_entry(name: str, table: Any, millimetres: float, faults: list[str]) -> dict[str, object]:
    if not isinstance(table, dict):
        faults.append(f"{name} is no table")
        return {}
    if isinstance(table.get("name"), str):
        name = table["name"]
    fisheye = table.get("fisheye") is True
    if table.get("rotation_count") not in (None, 0):
        faults.append(f"{name}.rotation_count is {table['rotation_count']!r:.20}: turn its images and calibrate again")
    matrix = number_array(table.get("matrix"), (3, 3), f"{name}.matrix", faults)
    rotation = number_array(table.get("rotation"), None, f"{name}.rotation", faults)
    translation = number_array(table.get("translation"), (3,), f"{name}.translation", faults)
    lens = number_array(table.get("distortions", [0.0] * 4), None, f"{name}.distortions", faults)
    if rotation.shape == (3,):
        rotation = rotation_from_vector(rotation) if np.isfinite(rotation).all() else np.full((3, 3), np.nan)
    names = COEFFICIENTS["kannala-brandt" if fisheye else "rational"]
    if lens.ndim != 1 or not 1 <= len(lens) <= 14 or lens[len(names) :].any():
        faults.append(f"{name}.distortions must be at most {len(names)} coefficients ({' '.join(names)})")
    if matrix.shape == (3, 3) and abs(matrix[0, 1]) > 1e-6 * abs(matrix[0, 0]):
        faults.append(f"{name}.matrix has skew, which is not supported")
    size = table.get("size")
    width, height = size if isinstance(size, list) and len(size) == 2 else (None, None)
    return {
        "name": name,
        "width": width,
        "height": height,
        "intrinsics": {key: float(matrix[at]) for key, at in MATRIX_PLACES.items()},
        "distortion": lens_entry(dict(zip(names, lens.ravel().tolist(), strict=False)), fisheye=fisheye),
        "camera_from_world": {"rotation": rotation.tolist(), "translation": (millimetres * translation).tolist()},
    }


def _aniposelib_unit(document: Mapping[str, object], pairs: list[tuple[str, Any]]) -> float:
    """Millimetres in one unit of the file. Its ``metadata.unit`` says so; without it, the size of the rig does:
    aniposelib takes the unit of the board, and cameras within 30 of each other are a rig in metres."""
    metadata = document.get("metadata")
    unit = metadata.get("unit") if isinstance(metadata, dict) else None
    if unit in ("mm", "m"):
        return 1.0 if unit == "mm" else 1000.0
    lengths = [
        np.abs(number_array(table.get("translation"), (3,), "", [])).max()
        for _, table in pairs
        if isinstance(table, dict)
    ]
    # |t| is the distance of the world's origin, which lies at a camera or at the board: never beyond the rig.
    return 1000.0 if lengths and max(lengths) < METRES_MOST else 1.0


def looks_like_aniposelib(path: Path) -> bool:
    try:
        document = parsed(path, lambda data: tomllib.loads(data.decode("utf-8-sig")))
    except InputError:
        return False
    tables = [table for key, table in document.items() if key != "metadata" and isinstance(table, dict)]
    return bool(tables) and all({"matrix", "rotation", "translation"} <= table.keys() for table in tables)


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
