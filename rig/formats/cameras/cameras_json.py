"""Reads and writes ``cameras.json`` (``eigenhead-cameras/1``), this project's file format for a rig's cameras."""

import json
from pathlib import Path
from typing import Any, NotRequired, TypedDict

import numpy as np

from rig.camera import Camera, Distortion, Intrinsics
from rig.errors import InputError
from rig.files import write_atomically
from rig.formats.pictures.picture_names import safe_name
from rig.geometry import RigidTransform, nearest_rotation
from rig.messages.message import Message, compose, say_once
from rig.recorded_lens import COEFFICIENTS, LensModel, RecordedLens
from rig.rig import Rig

FORMAT = "eigenhead-cameras/1"
CAMERAS_LEAST, CAMERAS_MOST = 3, 64  # that take part; of more, those that stand well apart are taken
CAMERAS_READ_MOST = 1024  # in a file: six times the largest person scanner's
SERIAL_MOST = 64
UNITS_MM = {"m": 1000, "meter": 1000, "metre": 1000, "meters": 1000, "metres": 1000, "cm": 10, "in": 25.4, "inch": 25.4}
PIXELS_MOST = 20_000  # a side; larger is a damaged or hostile file, not a camera


class PoseDocument(TypedDict):
    """Describes a pose in JSON: the rows of a rotation matrix, and a translation (mm)."""

    rotation: list[list[float]]
    translation: list[float]


class CameraDocument(TypedDict):
    """Describes one camera in JSON. ``covariance`` (6 x 6) lists rotation (rad), then translation (mm). ``serial`` is
    the camera body's serial number from EXIF."""

    name: str
    width: int
    height: int
    intrinsics: dict[str, float]
    distortion: dict[str, str | float]
    camera_from_world: PoseDocument
    covariance: NotRequired[list[list[float]]]
    serial: NotRequired[str]


class CamerasDocument(TypedDict):
    """Describes ``cameras.json``. ``scale_sigma`` is the relative standard deviation of all lengths."""

    format: str
    unit: str
    cameras: list[CameraDocument]
    scale_sigma: NotRequired[float]


def read_rig(path: Path) -> Rig:
    """Returns the rig in ``cameras.json``. Raises InputError naming every fault."""
    return rig_from_document(read_document(path), path.name)


def read_document(path: Path) -> Any:
    """Decodes a JSON file. Raises InputError if the file is no JSON."""
    try:
        return json.loads(path.read_bytes())  # UTF-8, 16 or 32, which json recognises by the first bytes
    except OSError as error:
        raise InputError(path.name, [compose("no-file-read", reason=error.strerror or str(error))]) from error
    except json.JSONDecodeError as error:
        raise InputError(
            path.name, [compose("no-json", reason=f"line {error.lineno}, column {error.colno}")]
        ) from error
    except (ValueError, RecursionError) as error:
        raise InputError(path.name, [compose("no-json", reason="text in UTF-8 is wanted")]) from error


def write_rig(rig: Rig, path: Path) -> None:
    """Writes ``cameras.json`` atomically."""
    write_atomically(path, json.dumps(document_from_rig(rig), indent=1).encode())


def document_from_rig(rig: Rig) -> CamerasDocument:
    """Returns the content of ``cameras.json`` for a rig."""
    document: CamerasDocument = {
        "format": FORMAT,
        "unit": "mm",
        "cameras": [_camera_document(camera) for camera in rig],
    }
    if rig.scale_sigma:
        document["scale_sigma"] = rig.scale_sigma
    return document


def rig_from_document(document: Any, subject: str = "cameras.json") -> Rig:
    """Returns the rig in a decoded ``cameras.json``. Raises InputError naming every fault."""
    if not isinstance(document, dict) or not isinstance(document.get("cameras"), list):
        raise InputError(subject, [compose("no-camera-list")])
    faults: list[Message] = []
    if document.get("format") != FORMAT:
        faults.append(compose("format-is", format=f"{document.get('format')!r:.80}", wanted=f"{FORMAT!r}"))
    if document.get("unit", "mm") != "mm":
        faults.append(_unit_fault(document["unit"]))
    entries = document["cameras"]
    if not CAMERAS_LEAST <= len(entries) <= CAMERAS_READ_MOST:
        most = CAMERAS_MOST if len(entries) < CAMERAS_LEAST else CAMERAS_READ_MOST
        faults.append(compose("cameras-few-or-many", count=len(entries), least=CAMERAS_LEAST, most=most))
    places = [f"cameras[{i}]" for i in range(len(entries[:CAMERAS_READ_MOST]))]
    cameras = [_read_camera(entry, place, faults) for entry, place in zip(entries, places, strict=False)]
    found = [camera for camera in cameras if camera is not None]
    names = [camera.name for camera in found]
    faults += _repeated(names) + _shared_serials(found)
    scale_sigma = document.get("scale_sigma", 0.0)
    if not is_number(scale_sigma) or not 0.0 <= scale_sigma < 1.0:
        faults.append(compose("no-share", key="scale_sigma", value=f"{scale_sigma!r:.80}"))
    if faults:
        read = [entry for entry in entries[:CAMERAS_READ_MOST] if isinstance(entry, dict)]
        written = [entry["name"] for entry in read if isinstance(entry.get("name"), str)]
        raise InputError(subject, say_once(faults, [*filter(None, written), *places]))
    return Rig(tuple(found), float(scale_sigma))


def _unit_fault(unit: Any) -> Message:
    """Returns a fault that reports a unit other than millimetres, with the unit's factor if the unit is known."""
    written = f"{unit!r:.80}"
    factor = UNITS_MM.get(unit.lower()) if isinstance(unit, str) else None
    if factor is None:
        return compose("unit-is", unit=written)
    return compose("unit-of-length", unit=written, factor=factor)


def _repeated(names: list[str]) -> list[Message]:
    """Returns one fault that lists all names that several cameras have."""
    repeated = [name for name in sorted(set(names)) if names.count(name) > 1]
    if not repeated:
        return []
    camera, times, more = f"{repeated[0]!r}", names.count(repeated[0]), len(repeated) - 1
    if more:
        return [compose("cameras-repeated", camera=camera, times=times, count=more)]
    return [compose("camera-repeated", camera=camera, times=times)]


def _shared_serials(cameras: list[Camera]) -> list[Message]:
    owners: dict[str, list[str]] = {}
    for camera in cameras:
        if camera.serial is not None:
            owners.setdefault(camera.serial, []).append(camera.name)
    shared = {serial: names for serial, names in owners.items() if len(names) > 1}
    return [compose("serial-shared", cameras=names, serial=f"{serial!r}") for serial, names in shared.items()]


def name_fault(name: Any) -> Message | None:
    """Returns a fault if ``name`` cannot be a camera's name, which must be valid as a file name; otherwise None."""
    if not isinstance(name, str) or not 0 < len(name) <= 64:
        return compose("camera-name-length", name=f"{name!r:.80}", most=64)
    if not all(c.isascii() and (c.isalnum() or c in "-_.") for c in name) or name.startswith("."):
        return compose("camera-name-signs", name=f"{name!r}")
    return None


def _camera_document(camera: Camera) -> CameraDocument:
    k = camera.intrinsics
    document: CameraDocument = {
        "name": camera.name,
        "width": k.width,
        "height": k.height,
        "intrinsics": {"fx": k.fx, "fy": k.fy, "cx": k.cx, "cy": k.cy},
        "distortion": _lens_document(camera),
        "camera_from_world": {
            "rotation": camera.camera_from_world.rotation.tolist(),
            "translation": camera.camera_from_world.translation.tolist(),
        },
    }
    if camera.covariance is not None:
        document["covariance"] = camera.covariance.tolist()
    if camera.serial is not None:
        document["serial"] = camera.serial
    return document


def _lens_document(camera: Camera) -> dict[str, str | float]:
    d, lens = camera.intrinsics.distortion, camera.recorded
    if lens is None:
        return {"model": "brown-conrady", "k1": d.k1, "k2": d.k2, "p1": d.p1, "p2": d.p2, "k3": d.k3}
    values: dict[str, str | float] = dict(zip(COEFFICIENTS[lens.model], lens.coefficients, strict=True))
    return {"model": lens.model, **values} | ({"skew": lens.skew} if lens.skew else {})


def _read_lens(lens: Any, where: str, faults: list[Message]) -> tuple[Distortion, RecordedLens | None]:
    """Returns the camera's Brown-Conrady distortion. For another lens model, returns zero distortion and the lens by
    which pictures are undistorted on reading."""
    model = lens.get("model", "brown-conrady") if isinstance(lens, dict) else "brown-conrady"
    known: LensModel | None = next((name for name in COEFFICIENTS if name == model), None)
    if known is None and model != "brown-conrady":
        models = [f"{model!r}" for model in ("brown-conrady", *COEFFICIENTS)]
        faults.append(compose("value-none-of", key=f"{where}.model", value=f"{model!r:.80}", known=models))
    keys = COEFFICIENTS[known] if known else ("k1", "k2", "p1", "p2", "k3")
    *values, skew = _read_numbers(lens, (*keys, "skew"), where, faults, default=0.0)
    if known is None and skew:  # Brown and Conrady's lens is the rational one without quotient
        known, values = "rational", [*values, 0.0, 0.0, 0.0]
    return (Distortion(), RecordedLens(known, tuple(values), skew)) if known else (Distortion(*values), None)


def _read_camera(entry: Any, where: str, faults: list[Message]) -> Camera | None:
    before = len(faults)
    if not isinstance(entry, dict):
        faults.append(compose("no-object", key=where))
        return None
    name = safe_name(entry["name"]) if isinstance(entry.get("name"), str) else ""
    if fault := name_fault(name or entry.get("name")):
        faults.append(compose("of-key", key=f"{where}.name", fault=fault))
    else:
        where = name
    width, height = (_read_size(entry.get(key), f"{where}.{key}", faults) for key in ("width", "height"))
    fx, fy, cx, cy = _read_numbers(entry.get("intrinsics"), ("fx", "fy", "cx", "cy"), f"{where}.intrinsics", faults)
    distortion, recorded = _read_lens(entry.get("distortion", {}), f"{where}.distortion", faults)
    pose = entry.get("camera_from_world")
    pose = pose if isinstance(pose, dict) else {}
    rotation = _read_array(pose.get("rotation"), (3, 3), f"{where}.camera_from_world.rotation", faults)
    translation = _read_array(pose.get("translation"), (3,), f"{where}.camera_from_world.translation", faults)
    covariance = None
    if entry.get("covariance") is not None:
        covariance = _read_array(entry["covariance"], (6, 6), f"{where}.covariance", faults)
        if covariance is not None and not _is_covariance(covariance):
            faults.append(compose("no-covariance", key=f"{where}.covariance"))
    if rotation is not None:
        faults += _rotation_faults(rotation, where)
    serial = entry.get("serial")
    if serial is not None and not (isinstance(serial, str) and 0 < len(serial) <= SERIAL_MOST):
        serial_key, value = f"{where}.serial", f"{serial!r:.80}"
        faults.append(compose("no-text-of", key=serial_key, value=value, most=SERIAL_MOST))
    if len(faults) == before and not (fx > 0 and fy > 0):
        faults.append(compose("focal-lengths-positive", key=f"{where}.intrinsics"))
    if len(faults) > before or rotation is None or translation is None or not width or not height:
        return None
    intrinsics = Intrinsics(width, height, fx, fy, cx, cy, distortion)
    pose = RigidTransform(nearest_rotation(rotation), translation)
    return Camera(name, intrinsics, pose, covariance, recorded, serial)


def _rotation_faults(rotation: np.ndarray, where: str) -> list[Message]:
    key = f"{where}.camera_from_world.rotation"
    # Files with six digits are off by 1e-6; a mirrored or scaled matrix is off by far more than 1e-3.
    if np.abs(rotation @ rotation.T - np.eye(3)).max() > 1e-3:
        return [compose("rotation-not-orthonormal", key=key)]
    if np.linalg.det(rotation) < 0:
        return [compose("rotation-mirrored", key=key)]
    return []


def _is_covariance(matrix: np.ndarray) -> bool:
    scale = np.sqrt(np.abs(np.diag(matrix))) + 1e-12
    correlation = matrix / np.outer(scale, scale)
    return bool(np.abs(correlation - correlation.T).max() < 1e-6 and np.linalg.eigvalsh(correlation).min() > -1e-6)


def is_number(value: Any) -> bool:
    """Returns whether a decoded value is a finite number of plausible size."""
    return isinstance(value, int | float) and not isinstance(value, bool) and bool(abs(value) < 1e12)  # NaN fails too


def _read_size(value: Any, where: str, faults: list[Message]) -> int:
    if not is_number(value) or value != int(value) or not 16 <= value <= PIXELS_MOST:
        faults.append(compose("no-pixel-count", key=where, value=f"{value!r:.80}", most=PIXELS_MOST))
        return 0
    return int(value)


def _read_numbers(
    entry: Any, keys: tuple[str, ...], where: str, faults: list[Message], default: float | None = None
) -> list[float]:
    if not isinstance(entry, dict):
        faults.append(compose("no-object-of", key=where, names=keys))
        return [0.0] * len(keys)
    values = [entry.get(key, default) for key in keys]
    for key, value in zip(keys, values, strict=True):
        if not is_number(value):
            faults.append(compose("no-finite-number", key=f"{where}.{key}", value=f"{value!r:.80}"))
    return [float(value) if is_number(value) else 0.0 for value in values]  # type: ignore[arg-type]


def _read_array(value: Any, shape: tuple[int, ...], where: str, faults: list[Message]) -> np.ndarray | None:
    try:
        array = np.array(value, dtype=object)  # float would read "1" and true as numbers
    except ValueError:
        array = np.zeros(0)
    if array.shape != shape:
        vector = shape == (3, 3) and array.squeeze().shape == (3,)
        code = "rotation-vector" if vector else "no-numbers-of-shape"
        faults.append(compose(code, key=where, shape=" x ".join(map(str, shape))))
        return None
    if not all(is_number(entry) for entry in array.flat):
        faults.append(compose("holds-no-finite-number", key=where))
        return None
    return array.astype(float)
