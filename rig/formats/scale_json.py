"""What makes a scene's unit millimetres: ``scale.json``, one of three ways to know a length in it.

{"points": {"a": {CAMERA: [x, y], ...}, "b": {...}}, "distance_mm": 62.0}     two points, seen by two cameras or more
{"tag": {"dictionary": "DICT_4X4_50", "size_mm": 40.0}}                       printed ArUco tags, their black side
{"cameras": [CAMERA, CAMERA], "distance_mm": 410.0}                           the distance of two cameras' centres
"""

import json
from collections.abc import Collection, Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
from jaxtyping import Float

from rig.errors import InputError
from rig.formats.cameras_json import PIXELS_MOST
from rig.text import printable

KINDS = ("points", "tag", "cameras")


@dataclass(frozen=True, slots=True, eq=False)
class PointDistance:
    """Pixels of two points of the scene by camera, and how far apart they are."""

    first: Mapping[str, Float[np.ndarray, " 2"]]
    second: Mapping[str, Float[np.ndarray, " 2"]]
    distance_mm: float


@dataclass(frozen=True, slots=True)
class TagSize:
    """Tags of one of OpenCV's ArUco dictionaries, of one size."""

    dictionary: str
    size_mm: float


@dataclass(frozen=True, slots=True)
class CameraDistance:
    """How far apart the centres of two cameras are."""

    cameras: tuple[str, str]
    distance_mm: float


KnownLength = PointDistance | TagSize | CameraDistance


def read_scale(path: Path, cameras: Collection[str]) -> KnownLength:
    """Reads ``scale.json`` for photographs of ``cameras``. Raises InputError naming every fault."""
    try:
        document = json.loads(path.read_text(encoding="utf-8-sig"))
    except (OSError, ValueError, RecursionError) as error:
        raise InputError(path.name, [f"cannot be read as JSON ({error})"]) from error
    return scale_from_document(document, cameras, path.name)


def scale_from_document(document: Any, cameras: Collection[str], subject: str = "scale.json") -> KnownLength:
    """The length in a decoded ``scale.json``. Raises InputError naming every fault."""
    given = [kind for kind in KINDS if isinstance(document, dict) and kind in document]
    if len(given) != 1:
        told = f"holds {' and '.join(given)}" if given else "holds none of them"
        raise InputError(subject, [f"wants one of {', '.join(KINDS)}, {told}"])
    faults: list[str] = []
    unknown = sorted(set(document) - {given[0], "distance_mm"} - {"format"})
    faults += [f"{key!r:.80} is no key of it" for key in unknown]
    readers = {"points": _points, "tag": _tag, "cameras": _cameras}
    known = readers[given[0]](document, cameras, faults)
    if faults or known is None:
        raise InputError(subject, faults)
    return known


def _points(document: dict[str, Any], cameras: Collection[str], faults: list[str]) -> PointDistance | None:
    distance = _length(document, "distance_mm", faults)
    points = document["points"]
    if not isinstance(points, dict) or len(points) != 2:
        faults.append("points: wants an object of two points, each an object of camera: [x, y]")
        return None
    ends = [_pixels(views, f"points.{printable(name):.80}", cameras, faults) for name, views in points.items()]
    first, second = ends
    shared = [name for name in first if name in second]
    # One alone may lie behind the other in one picture, in two it cannot.
    if len(shared) > 1 and all(np.array_equal(first[name], second[name]) for name in shared):
        told = " and ".join(f"{printable(name):.80}" for name in points)
        faults.append(f"points: {told} are one place in {' and '.join(shared)}: pick two places")
    return PointDistance(first, second, distance)


def _pixels(views: Any, where: str, cameras: Collection[str], faults: list[str]) -> dict[str, np.ndarray]:
    if not isinstance(views, dict) or len(views) < 2:
        faults.append(f"{where}: a point must be picked in two cameras or more")
        return {}
    for name, pixel in views.items():
        if name not in cameras:
            faults.append(f"{where} names {name!r:.80}, of which there is no photograph")
        if not (isinstance(pixel, list) and len(pixel) == 2 and all(map(_is_place, pixel))):
            faults.append(
                f"{where}.{printable(name):.80} is {pixel!r:.80}, wanted [x, y] in pixels, 0 to {PIXELS_MOST}"
            )
    return {} if faults else {name: np.array(pixel, float) for name, pixel in views.items()}


def _tag(document: dict[str, Any], cameras: Collection[str], faults: list[str]) -> TagSize | None:
    tag = document["tag"]
    if not isinstance(tag, dict):
        faults.append("tag: wants an object with dictionary and size_mm")
        return None
    faults += [f"{'tag.' + key!r:.80} is no key of it" for key in sorted(set(tag) - {"dictionary", "size_mm"})]
    name = tag.get("dictionary")
    if not isinstance(name, str) or name not in dictionaries():
        faults.append(f"tag.dictionary is {name!r:.80}, wanted one of OpenCV's, such as 'DICT_4X4_50'")
    return TagSize(str(name), _length(tag, "size_mm", faults, "tag."))


def dictionaries() -> dict[str, int]:
    """OpenCV's predefined ArUco dictionaries by name."""
    import cv2

    return {name: getattr(cv2.aruco, name) for name in dir(cv2.aruco) if name.startswith("DICT_")}


def _cameras(document: dict[str, Any], cameras: Collection[str], faults: list[str]) -> CameraDistance | None:
    distance = _length(document, "distance_mm", faults)
    names = document["cameras"]
    if not isinstance(names, list) or len(names) != 2 or names[0] == names[1]:
        faults.append("cameras: wants the names of two cameras")
        return None
    faults += [f"cameras names {name!r:.80}, of which there is no photograph" for name in names if name not in cameras]
    return CameraDistance((names[0], names[1]), distance)


def _length(document: dict[str, Any], key: str, faults: list[str], where: str = "") -> float:
    value: Any = document.get(key)
    if not _is_number(value) or not 0.1 <= value <= 1e5:
        faults.append(f"{where}{key} is {value!r:.80}, wanted a length in millimetres, 0.1 to 100000")
        return 1.0
    return float(value)


def _is_place(value: Any) -> bool:
    return _is_number(value) and -1.0 < value < PIXELS_MOST  # a pixel's area reaches half of one beyond its centre


def _is_number(value: Any) -> bool:
    # NaN fails the comparison, and so does a whole number too large for a float
    return isinstance(value, int | float) and not isinstance(value, bool) and abs(value) < 1e9
