"""The project's own file for a rig's cameras: ``cameras.json`` (``eigenhead-cameras/1``)."""

import json
from pathlib import Path
from typing import Any, NotRequired, TypedDict

import numpy as np

from rig.atomic_write import write_atomically
from rig.camera import Camera, Distortion, Intrinsics
from rig.errors import InputError
from rig.geometry import RigidTransform, nearest_rotation
from rig.recorded_lens import COEFFICIENTS, LensModel, RecordedLens
from rig.rig import Rig

FORMAT = "eigenhead-cameras/1"
CAMERAS_LEAST, CAMERAS_MOST = 3, 64
SERIAL_MOST = 64
PIXELS_MOST = 20_000  # a side; larger is a damaged or hostile file, not a camera


class PoseDocument(TypedDict):
    rotation: list[list[float]]
    translation: list[float]


class CameraDocument(TypedDict):
    """``covariance``: 6 x 6, rotation (rad) then translation (mm); ``serial``: of the body, as EXIF has it."""

    name: str
    width: int
    height: int
    intrinsics: dict[str, float]
    distortion: dict[str, str | float]
    camera_from_world: PoseDocument
    covariance: NotRequired[list[list[float]]]
    serial: NotRequired[str]


class CamerasDocument(TypedDict):
    """``cameras.json``."""

    format: str
    unit: str
    cameras: list[CameraDocument]


def read_rig(path: Path) -> Rig:
    """Reads ``cameras.json``. Raises InputError naming every fault in it."""
    try:
        document = json.loads(path.read_text(encoding="utf-8-sig"))
    except (OSError, ValueError, RecursionError) as error:
        raise InputError(path.name, [f"cannot be read as JSON ({error})"]) from error
    return rig_from_document(document, path.name)


def write_rig(rig: Rig, path: Path) -> None:
    write_atomically(path, json.dumps(document_from_rig(rig), indent=1).encode())


def document_from_rig(rig: Rig) -> CamerasDocument:
    return {"format": FORMAT, "unit": "mm", "cameras": [_camera_document(camera) for camera in rig]}


def rig_from_document(document: Any, subject: str = "cameras.json") -> Rig:
    """The rig in a decoded ``cameras.json``. Raises InputError naming every fault."""
    if not isinstance(document, dict) or not isinstance(document.get("cameras"), list):
        raise InputError(subject, ["is no object with a list 'cameras'"])
    faults = []
    if document.get("format") != FORMAT:
        faults.append(f"format is {document.get('format')!r:.80}, wanted {FORMAT!r}")
    if document.get("unit", "mm") != "mm":
        faults.append(f"unit is {document['unit']!r:.80}, wanted 'mm'")
    entries = document["cameras"]
    if not CAMERAS_LEAST <= len(entries) <= CAMERAS_MOST:
        faults.append(f"{len(entries)} cameras; between {CAMERAS_LEAST} and {CAMERAS_MOST} work")
    cameras = [_read_camera(entry, f"cameras[{i}]", faults) for i, entry in enumerate(entries[:CAMERAS_MOST])]
    found = [camera for camera in cameras if camera is not None]
    names = [camera.name for camera in found]
    faults += _repeated(names) + _shared_serials(found)
    if faults:
        raise InputError(subject, faults)
    return Rig(tuple(found))


def _repeated(names: list[str]) -> list[str]:
    """One sentence for all names that several cameras have: a list written twice repeats every one of them."""
    repeated = [name for name in sorted(set(names)) if names.count(name) > 1]
    if not repeated:
        return []
    first = f"camera {repeated[0]!r} occurs {names.count(repeated[0])} times"
    return [first if len(repeated) == 1 else f"{first}, and {len(repeated) - 1} more names occur several times"]


def _shared_serials(cameras: list[Camera]) -> list[str]:
    owners: dict[str, list[str]] = {}
    for camera in cameras:
        if camera.serial is not None:
            owners.setdefault(camera.serial, []).append(camera.name)
    told = "one body is one camera: correct or leave out their serials"
    return [f"{' and '.join(own)} have the serial {serial!r}: {told}" for serial, own in owners.items() if len(own) > 1]


def name_fault(name: Any) -> str | None:
    """Why ``name`` cannot be a camera's name, which becomes a file name; None if it can."""
    if not isinstance(name, str) or not 0 < len(name) <= 64:
        return f"{name!r:.80} is no name of 1 to 64 characters"
    if not all(c.isascii() and (c.isalnum() or c in "-_.") for c in name) or name.startswith("."):
        return f"{name!r} may hold only ASCII letters, digits, '-', '_' and '.', and may not start with '.'"
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
    return {"model": lens.model, **dict(zip(COEFFICIENTS[lens.model], lens.coefficients, strict=True))}


def _read_lens(lens: Any, where: str, faults: list[str]) -> tuple[Distortion, RecordedLens | None]:
    """Our own lens, or a pinhole and the lens that its pictures are undistorted from."""
    model = lens.get("model", "brown-conrady") if isinstance(lens, dict) else "brown-conrady"
    known: LensModel | None = next((name for name in COEFFICIENTS if name == model), None)
    if known is None and model != "brown-conrady":
        faults.append(f"{where}.model is {model!r:.80}, wanted 'brown-conrady', {' or '.join(map(repr, COEFFICIENTS))}")
    keys = COEFFICIENTS[known] if known else ("k1", "k2", "p1", "p2", "k3")
    values = _read_numbers(lens, keys, where, faults, default=0.0)
    return (Distortion(), RecordedLens(known, tuple(values))) if known else (Distortion(*values), None)


def _read_camera(entry: Any, where: str, faults: list[str]) -> Camera | None:
    before = len(faults)
    if not isinstance(entry, dict):
        faults.append(f"{where} is no object")
        return None
    fault = name_fault(entry.get("name"))
    if fault:
        faults.append(f"{where}.name {fault}")
    else:
        where = entry["name"]
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
            faults.append(f"{where}.covariance is not symmetric and positive semi-definite")
    if rotation is not None:
        faults += _rotation_faults(rotation, where)
    serial = entry.get("serial")
    if serial is not None and not (isinstance(serial, str) and 0 < len(serial) <= SERIAL_MOST):
        faults.append(f"{where}.serial is {serial!r:.80}, wanted text of 1 to {SERIAL_MOST} characters")
    if len(faults) == before and not (fx > 0 and fy > 0):
        faults.append(f"{where}.intrinsics: fx and fy must be positive")
    if len(faults) > before or rotation is None or translation is None or not width or not height:
        return None
    intrinsics = Intrinsics(width, height, fx, fy, cx, cy, distortion)
    pose = RigidTransform(nearest_rotation(rotation), translation)
    return Camera(entry["name"], intrinsics, pose, covariance, recorded, serial)


def _rotation_faults(rotation: np.ndarray, where: str) -> list[str]:
    # Files with six digits are off by 1e-6; a mirrored or scaled matrix is off by far more than 1e-3.
    if np.abs(rotation @ rotation.T - np.eye(3)).max() > 1e-3:
        return [f"{where}.camera_from_world.rotation is not orthonormal: give every digit of a rotation matrix"]
    if np.linalg.det(rotation) < 0:
        told = f"{where}.camera_from_world.rotation has determinant -1: a mirrored frame; negate one axis of the world"
        return [f"{told} in every pose, so that it is right-handed"]
    return []


def _is_covariance(matrix: np.ndarray) -> bool:
    scale = np.sqrt(np.abs(np.diag(matrix))) + 1e-12
    correlation = matrix / np.outer(scale, scale)
    return bool(np.abs(correlation - correlation.T).max() < 1e-6 and np.linalg.eigvalsh(correlation).min() > -1e-6)


def _is_number(value: Any) -> bool:
    return isinstance(value, int | float) and not isinstance(value, bool) and abs(value) < 1e12  # NaN fails too


def _read_size(value: Any, where: str, faults: list[str]) -> int:
    if not _is_number(value) or value != int(value) or not 16 <= value <= PIXELS_MOST:
        faults.append(f"{where} is {value!r:.80}, wanted a whole number of pixels from 16 to {PIXELS_MOST}")
        return 0
    return int(value)


def _read_numbers(
    entry: Any, keys: tuple[str, ...], where: str, faults: list[str], default: float | None = None
) -> list[float]:
    if not isinstance(entry, dict):
        faults.append(f"{where} is missing or no object: wanted are {', '.join(keys)} by name")
        return [0.0] * len(keys)
    values = [entry.get(key, default) for key in keys]
    for key, value in zip(keys, values, strict=True):
        if not _is_number(value):
            faults.append(f"{where}.{key} is {value!r:.80}, wanted a finite number")
    return [float(value) if _is_number(value) else 0.0 for value in values]  # type: ignore[arg-type]


def _read_array(value: Any, shape: tuple[int, ...], where: str, faults: list[str]) -> np.ndarray | None:
    try:
        array = np.array(value, dtype=object)  # float would read "1" and true as numbers
    except ValueError:
        array = np.zeros(0)
    if array.shape != shape:
        told = f"{where} is missing or not {' x '.join(map(str, shape))} numbers"
        vector = shape == (3, 3) and array.squeeze().shape == (3,)
        faults.append(f"{told}: of a rotation vector write the matrix (cv2.Rodrigues)" if vector else told)
        return None
    if not all(_is_number(entry) for entry in array.flat):
        faults.append(f"{where} holds a value that is no finite number")
        return None
    return array.astype(float)
