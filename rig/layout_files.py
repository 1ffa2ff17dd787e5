"""Rigs in other programs' files: COLMAP (text and binary), caliscope's ``camera_array.toml``, aniposelib's TOML.

Every reader turns its file into the ``eigenhead-cameras/1`` document and lets ``rig_from_document`` judge it, so that
all formats meet the same checks. Sources of the layouts: https://colmap.github.io/format.html (with the parameter order
of ``src/colmap/sensor/models.h``), https://mprib.github.io/caliscope, https://anipose.readthedocs.io.

Pixels: COLMAP puts (0.5, 0.5) at the centre of the top-left pixel, this project (0, 0); the two TOML formats follow
OpenCV and need no shift. Lengths: caliscope is in metres; COLMAP's scale is free and taken as millimetres; aniposelib's
is that of its board, see ``_aniposelib_unit``.
"""

import json
import math
import struct
import tomllib
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import Any

import numpy as np

from rig.camera import Camera
from rig.errors import InputError
from rig.files import write_atomically
from rig.geometry import rotation_from_vector, vector_from_rotation
from rig.layout import CAMERAS_MOST, FORMAT, Rig, read_rig, rig_from_document, write_rig

BYTES_MOST = 1 << 29  # a sparse model of a rig is a few megabytes; its 2D points may be many
METRES_MOST = 30.0  # the widest head rig, in metres; in millimetres it would fit in a hand

# name: (number in the binary file, parameter names in their order). Fisheye and other models have no counterpart here.
COLMAP_MODELS: dict[str, tuple[int, tuple[str, ...]]] = {
    "SIMPLE_PINHOLE": (0, ("f", "cx", "cy")),
    "PINHOLE": (1, ("fx", "fy", "cx", "cy")),
    "SIMPLE_RADIAL": (2, ("f", "cx", "cy", "k1")),
    "RADIAL": (3, ("f", "cx", "cy", "k1", "k2")),
    "OPENCV": (4, ("fx", "fy", "cx", "cy", "k1", "k2", "p1", "p2")),
    "FULL_OPENCV": (6, ("fx", "fy", "cx", "cy", "k1", "k2", "p1", "p2", "k3", "k4", "k5", "k6")),
}
COLMAP_NAMES = {number: name for name, (number, _) in COLMAP_MODELS.items()}
FORMATS = ("eigenhead", "colmap", "colmap-text", "caliscope", "aniposelib")
COLMAP_FOLDERS = ("sparse/0", "sparse", ".")


def find_rig_file(folder: Path) -> Path | None:
    """The file in ``folder`` that holds the rig, for ``read_rig_file``; None if there is none.

    In this order: ``cameras.json``; a COLMAP model under ``sparse/0``, ``sparse`` or at the top (its ``cameras.bin`` or
    ``cameras.txt``); ``camera_array.toml``; any other TOML file with aniposelib's keys.
    """
    if (folder / "cameras.json").is_file():
        return folder / "cameras.json"
    for inner in COLMAP_FOLDERS:
        for suffix in (".bin", ".txt"):
            path = folder / inner / f"cameras{suffix}"
            if path.is_file():
                return path
    if (folder / "camera_array.toml").is_file():
        return folder / "camera_array.toml"
    return next((path for path in sorted(folder.glob("*.toml")) if _looks_like_aniposelib(path)), None)


def read_rig_file(path: Path) -> Rig:
    """The rig in a file of any known format. Raises InputError naming every fault found in it."""
    if path.suffix == ".json":
        return read_rig(path)
    if path.suffix in (".bin", ".txt"):
        return read_colmap(path.parent, path.suffix)
    if path.suffix == ".toml":
        return read_toml(path)
    raise InputError(path.name, ["is no rig file: wanted cameras.json, COLMAP's cameras.txt or .bin, or a .toml"])


def rig_file_parts(path: Path) -> tuple[Path, ...]:
    """The files from which ``read_rig_file`` reads ``path``: of a COLMAP model two, of the other formats one."""
    return (path, path.with_stem("images")) if path.suffix in (".bin", ".txt") else (path,)


def read_colmap(folder: Path, suffix: str = ".bin") -> Rig:
    """The rig in a COLMAP model: every image is a camera of this project, named after the image file."""
    files = [folder / f"{kind}{suffix}" for kind in ("cameras", "images")]
    subject = "/".join([folder.name, f"cameras{suffix}"]) if folder.name else f"cameras{suffix}"
    parsers: tuple[Callable[..., Any], ...] = (
        (_binary_cameras, _binary_images) if suffix == ".bin" else (_text_cameras, _text_images)
    )
    cameras, images = (_parse(path, parse) for path, parse in zip(files, parsers, strict=True))
    names = _image_names([image["name"] for image in images])
    faults: list[str] = []
    entries = []
    for name, image in zip(names, images, strict=True):
        camera = cameras.get(image["camera"])
        if camera is None:
            faults.append(f"image {name!r} names camera {image['camera']}, which cameras{suffix} lacks")
            continue
        entries.append(_colmap_entry(name, image, camera, faults))
    return _judge(entries, subject, faults)


def read_toml(path: Path) -> Rig:
    """The rig in caliscope's ``camera_array.toml`` or in an aniposelib calibration."""
    document = _parse(path, lambda data: tomllib.loads(data.decode()))
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
    return _judge(entries, path.name, faults)


def write_rig_file(rig: Rig, path: Path, kind: str) -> None:
    """Writes a rig in a format of ``FORMATS``; COLMAP's are folders. Raises InputError for another format."""
    writers: dict[str, Callable[[Rig, Path], None]] = {
        "eigenhead": write_rig,
        "colmap": lambda rig, folder: write_colmap(rig, folder, binary=True),
        "colmap-text": write_colmap,
        "caliscope": write_caliscope,
        "aniposelib": write_aniposelib,
    }
    assert tuple(writers) == FORMATS
    if kind not in writers:
        raise InputError("format", [f"{kind!r} is none of {', '.join(FORMATS)}"])
    writers[kind](rig, path)


def write_colmap(rig: Rig, folder: Path, *, binary: bool = False, suffix: str = ".png") -> None:
    """Writes ``cameras``, ``images`` and an empty ``points3D``; images are called ``<camera><suffix>``."""
    end = ".bin" if binary else ".txt"
    encode = _binary_model if binary else _text_model
    for kind, data in zip(("cameras", "images", "points3D"), encode(rig, suffix), strict=True):
        write_atomically(folder / f"{kind}{end}", data)


def write_caliscope(rig: Rig, path: Path) -> None:
    """Writes ``camera_array.toml``: metres, cameras numbered in the rig's order, names kept beside the numbers."""
    blocks = []
    for number, camera in enumerate(rig):
        keys = {"cam_id": number, "name": camera.name, "rotation_count": 0, "ignore": False, "fisheye": False}
        keys |= _toml_intrinsics(camera)
        keys["rotation"] = camera.camera_from_world.rotation.tolist()
        keys["translation"] = (camera.camera_from_world.translation / 1000.0).tolist()
        blocks.append(_toml_block(f"cameras.{number}", keys))
    write_atomically(path, "\n".join(blocks).encode())


def write_aniposelib(rig: Rig, path: Path) -> None:
    """Writes an aniposelib calibration, in millimetres (which ``metadata`` says)."""
    blocks = []
    for number, camera in enumerate(rig):
        keys = {"name": camera.name, **_toml_intrinsics(camera)}
        keys["rotation"] = vector_from_rotation(camera.camera_from_world.rotation).tolist()
        keys["translation"] = camera.camera_from_world.translation.tolist()
        blocks.append(_toml_block(f"cam_{number}", keys))
    blocks.append(_toml_block("metadata", {"unit": "mm"}))
    write_atomically(path, "\n".join(blocks).encode())


def _parse(path: Path, parse: Callable[[bytes], Any]) -> Any:
    """``parse`` of the file's bytes, with whatever damage it meets reported as InputError."""
    try:
        if path.stat().st_size > BYTES_MOST:
            raise InputError(path.name, [f"is larger than {BYTES_MOST >> 20} MiB"])
        return parse(path.read_bytes())
    except OSError as error:
        raise InputError(path.name, [f"cannot be read ({error.strerror or error})"]) from error
    except struct.error as error:
        raise InputError(path.name, ["ends in the middle of a record: it is truncated or no COLMAP file"]) from error
    except (ValueError, RecursionError) as error:
        raise InputError(path.name, [f"cannot be understood ({str(error)[:200]})"]) from error


def _judge(entries: list[dict[str, Any]], subject: str, faults: list[str]) -> Rig:
    """The rig of ``entries``. Raises InputError naming ``faults`` and those that ``rig_from_document`` finds."""
    try:
        rig = rig_from_document({"format": FORMAT, "unit": "mm", "cameras": entries}, subject)
    except InputError as error:
        raise InputError(subject, [*faults, *error.faults]) from None
    if faults:
        raise InputError(subject, faults)
    return rig


class _Records:
    """Little-endian records read one after the other; ``struct.error`` where the bytes end too early."""

    def __init__(self, data: bytes) -> None:
        self.data, self.at = data, 0

    def take(self, layout: str) -> tuple[Any, ...]:
        values = struct.unpack_from("<" + layout, self.data, self.at)
        self.at += struct.calcsize("<" + layout)
        return values

    def count(self, least_bytes: int) -> int:
        """A count whose records can still fit in the file; a larger one is damage, found before it costs anything."""
        (count,) = self.take("Q")
        if count * least_bytes > len(self.data) - self.at:
            raise ValueError(f"promises {count} records, more than the file can hold")
        return count

    def skip(self, size: int) -> None:
        self.at += size

    def text(self) -> str:
        end = self.data.find(b"\0", self.at)
        if end < 0:
            raise ValueError("a name has no end")
        text = self.data[self.at : end].decode("utf-8")
        self.at = end + 1
        return text


def _binary_cameras(data: bytes) -> dict[int, dict[str, Any]]:
    records = _Records(data)
    cameras = {}
    for _ in range(records.count(24)):
        number, model, width, height = records.take("iiQQ")
        name = COLMAP_NAMES.get(model)
        if name is None:
            raise ValueError(_model_fault(f"number {model}", number))
        values = records.take(f"{len(COLMAP_MODELS[name][1])}d")
        cameras[number] = {"model": name, "width": width, "height": height, "values": values}
    return cameras


def _binary_images(data: bytes) -> list[dict[str, Any]]:
    records = _Records(data)
    images = []
    for _ in range(_limited(records.count(73))):
        _, *pose, camera = records.take("i7di")
        images.append({"pose": pose, "camera": camera, "name": records.text()})
        records.skip(24 * records.count(24))
    return images


def _text_cameras(data: bytes) -> dict[int, dict[str, Any]]:
    cameras = {}
    for line in _text_lines(data):
        if not line.split():
            continue
        number, name, width, height, *values = line.split()
        if name not in COLMAP_MODELS:
            raise ValueError(_model_fault(repr(name)[:60], number))
        wanted = len(COLMAP_MODELS[name][1])
        if len(values) != wanted:
            raise ValueError(f"camera {number[:20]} has {len(values)} parameters; {name} has {wanted}")
        numbers = tuple(float(value) for value in values)
        cameras[int(number)] = {"model": name, "width": int(width), "height": int(height), "values": numbers}
    return cameras


def _text_images(data: bytes) -> list[dict[str, Any]]:
    images = []
    lines = _text_lines(data)
    for line in lines:
        if not line.split():
            continue
        words = line.split(maxsplit=9)
        if len(words) != 10:
            raise ValueError(f"an image line has {len(words)} entries, wanted 10")
        pose = [float(word) for word in words[1:8]]
        images.append({"pose": pose, "camera": int(words[8]), "name": words[9].strip()})
        next(lines, "")  # its 2D points
        _limited(len(images))
    return images


def _text_lines(data: bytes) -> Iterator[str]:
    return (line for line in data.decode("utf-8").splitlines() if not line.lstrip().startswith("#"))


def _limited(count: int) -> int:
    if count > CAMERAS_MOST:
        raise ValueError(f"{count} images; a rig has at most {CAMERAS_MOST} cameras, one image each")
    return count


def _model_fault(model: str, number: Any) -> str:
    return f"camera {number!s:.20} has the model {model}; known are {', '.join(COLMAP_MODELS)}"


def _image_names(files: list[str]) -> list[str]:
    """Camera names: the images' stems or, where those repeat (``cam00/shot.png``), the folders they lie in."""
    paths = [Path(file.replace("\\", "/")) for file in files]
    stems = [path.stem for path in paths]
    folders = [path.parent.name for path in paths]
    return folders if len(set(stems)) < len(stems) and all(folders) else stems


def _colmap_entry(name: str, image: dict[str, Any], camera: dict[str, Any], faults: list[str]) -> dict[str, Any]:
    parameters = dict(zip(COLMAP_MODELS[camera["model"]][1], camera["values"], strict=True))
    if any(parameters.get(key, 0.0) for key in ("k4", "k5", "k6")):
        faults.append(f"image {name!r}: k4, k5, k6 of FULL_OPENCV are not zero; calibrate with k1 k2 p1 p2 k3 only")
    focal = parameters.get("f", 0.0)
    w, x, y, z = _unit_quaternion(image["pose"][:4])
    rotation = [
        [1 - 2 * (y * y + z * z), 2 * (x * y - w * z), 2 * (x * z + w * y)],
        [2 * (x * y + w * z), 1 - 2 * (x * x + z * z), 2 * (y * z - w * x)],
        [2 * (x * z - w * y), 2 * (y * z + w * x), 1 - 2 * (x * x + y * y)],
    ]
    return {
        "name": name,
        "width": camera["width"],
        "height": camera["height"],
        "intrinsics": {
            "fx": parameters.get("fx", focal),
            "fy": parameters.get("fy", focal),
            "cx": parameters["cx"] - 0.5,
            "cy": parameters["cy"] - 0.5,
        },
        "distortion": {key: parameters.get(key, 0.0) for key in ("k1", "k2", "p1", "p2", "k3")},
        "camera_from_world": {"rotation": rotation, "translation": list(image["pose"][4:])},
    }


def _unit_quaternion(values: list[float]) -> tuple[float, ...]:
    length = math.hypot(*values)
    # A length far from 1 is no rotation; NaN is named by the document's own check.
    return tuple(value / length for value in values) if 0.9 < length < 1.1 else (math.nan,) * 4


def _toml_entry(name: str, table: Any, millimetres: float, faults: list[str]) -> dict[str, Any]:
    if not isinstance(table, dict):
        faults.append(f"{name} is no table")
        return {}
    if isinstance(table.get("name"), str):
        name = table["name"]
    if table.get("fisheye") is True:
        faults.append(f"{name} is a fisheye camera, which is not supported")
    if table.get("rotation_count") not in (None, 0):
        faults.append(f"{name}.rotation_count is {table['rotation_count']!r:.20}: turn its images and calibrate again")
    matrix = _numbers(table.get("matrix"), (3, 3), f"{name}.matrix", faults)
    rotation = _numbers(table.get("rotation"), None, f"{name}.rotation", faults)
    translation = _numbers(table.get("translation"), (3,), f"{name}.translation", faults)
    lens = _numbers(table.get("distortions", [0.0] * 5), None, f"{name}.distortions", faults)
    if rotation.shape == (3,):
        rotation = rotation_from_vector(rotation) if np.isfinite(rotation).all() else np.full((3, 3), np.nan)
    if lens.ndim != 1 or not 1 <= len(lens) <= 14 or lens[5:].any():
        faults.append(f"{name}.distortions must be at most 5 coefficients (k1 k2 p1 p2 k3)")
    if matrix.shape == (3, 3) and abs(matrix[0, 1]) > 1e-6 * abs(matrix[0, 0]):
        faults.append(f"{name}.matrix has skew, which is not supported")
    size = table.get("size")
    width, height = size if isinstance(size, list) and len(size) == 2 else (None, None)
    return {
        "name": name,
        "width": width,
        "height": height,
        "intrinsics": {key: float(matrix[at]) for key, at in _MATRIX_PLACES.items()},
        "distortion": dict(
            zip(("k1", "k2", "p1", "p2", "k3"), np.resize(np.append(lens, [0.0] * 5), 5).tolist(), strict=True)
        ),
        "camera_from_world": {"rotation": rotation.tolist(), "translation": (millimetres * translation).tolist()},
    }


_MATRIX_PLACES = {"fx": (0, 0), "fy": (1, 1), "cx": (0, 2), "cy": (1, 2)}


def _numbers(value: Any, shape: tuple[int, ...] | None, where: str, faults: list[str]) -> np.ndarray:
    """``value`` as an array; on a fault, one of NaN of the wanted shape, so that the other faults are still found."""
    try:
        array = np.array(value, dtype=float)
    except (TypeError, ValueError, OverflowError):
        array = np.zeros(())
    if array.ndim == 0 or (shape is not None and array.shape != shape):
        faults.append(f"{where} is missing or no list of {' x '.join(map(str, shape)) + ' ' if shape else ''}numbers")
        return np.full(shape or (3, 3), np.nan)
    return array


def _aniposelib_unit(document: dict[str, Any], pairs: list[tuple[str, Any]]) -> float:
    """Millimetres in one unit of the file. Its ``metadata.unit`` says so; without it, the size of the rig does:
    aniposelib takes the unit of the board, and cameras within 30 of each other are a rig in metres."""
    metadata = document.get("metadata")
    unit = metadata.get("unit") if isinstance(metadata, dict) else None
    if unit in ("mm", "m"):
        return 1.0 if unit == "mm" else 1000.0
    lengths = [
        np.abs(_numbers(table.get("translation"), (3,), "", [])).max() for _, table in pairs if isinstance(table, dict)
    ]
    # |t| is the distance of the world's origin, which lies at a camera or at the board: never beyond the rig.
    return 1000.0 if lengths and max(lengths) < METRES_MOST else 1.0


def _looks_like_aniposelib(path: Path) -> bool:
    try:
        document = _parse(path, lambda data: tomllib.loads(data.decode()))
    except InputError:
        return False
    tables = [table for key, table in document.items() if key != "metadata" and isinstance(table, dict)]
    return bool(tables) and all({"matrix", "rotation", "translation"} <= table.keys() for table in tables)


def _colmap_parameters(camera: Camera) -> list[float]:
    k, d = camera.intrinsics, camera.intrinsics.distortion
    return [k.fx, k.fy, k.cx + 0.5, k.cy + 0.5, d.k1, d.k2, d.p1, d.p2, d.k3, 0.0, 0.0, 0.0]


def _colmap_pose(camera: Camera) -> list[float]:
    vector = vector_from_rotation(camera.camera_from_world.rotation)
    angle = float(np.linalg.norm(vector))
    imaginary = vector * (math.sin(angle / 2) / angle if angle > 1e-12 else 0.5)
    return [math.cos(angle / 2), *imaginary.tolist(), *camera.camera_from_world.translation.tolist()]


def _text_model(rig: Rig, suffix: str) -> tuple[bytes, bytes, bytes]:
    cameras = ["# CAMERA_ID, MODEL, WIDTH, HEIGHT, PARAMS[]"]
    images = ["# IMAGE_ID, QW, QX, QY, QZ, TX, TY, TZ, CAMERA_ID, NAME", "# POINTS2D[] as (X, Y, POINT3D_ID)"]
    for number, camera in enumerate(rig, start=1):
        k = camera.intrinsics
        parameters = " ".join(map(repr, _colmap_parameters(camera)))
        cameras.append(f"{number} FULL_OPENCV {k.width} {k.height} {parameters}")
        images += [f"{number} {' '.join(map(repr, _colmap_pose(camera)))} {number} {camera.name}{suffix}", ""]
    points = "# POINT3D_ID, X, Y, Z, R, G, B, ERROR, TRACK[] as (IMAGE_ID, POINT2D_IDX)\n"
    return "\n".join([*cameras, ""]).encode(), "\n".join([*images, ""]).encode(), points.encode()


def _binary_model(rig: Rig, suffix: str) -> tuple[bytes, bytes, bytes]:
    count = struct.pack("<Q", len(rig))
    cameras, images = [count], [count]
    model = COLMAP_MODELS["FULL_OPENCV"][0]
    for number, camera in enumerate(rig, start=1):
        k = camera.intrinsics
        cameras.append(struct.pack("<iiQQ12d", number, model, k.width, k.height, *_colmap_parameters(camera)))
        images.append(struct.pack("<i7di", number, *_colmap_pose(camera), number))
        images.append(f"{camera.name}{suffix}".encode() + b"\0" + struct.pack("<Q", 0))
    return b"".join(cameras), b"".join(images), struct.pack("<Q", 0)


def _toml_intrinsics(camera: Camera) -> dict[str, Any]:
    k = camera.intrinsics
    return {
        "size": [k.width, k.height],
        "matrix": k.matrix().tolist(),
        "distortions": k.distortion.opencv().tolist(),
    }


def _toml_block(title: str, keys: dict[str, Any]) -> str:
    # Strings, booleans, numbers and nested lists of them read the same in JSON and TOML.
    return "\n".join([f"[{title}]", *(f"{key} = {json.dumps(value)}" for key, value in keys.items()), ""])
