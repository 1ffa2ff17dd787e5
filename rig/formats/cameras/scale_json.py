"""Reads ``scale.json``, which states a known length of a scene in one of three forms.

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
from rig.formats.cameras.cameras_json import PIXELS_MOST, is_number
from rig.messages.message import Message, compose
from rig.text import printable

KINDS = ("points", "tag", "cameras")


@dataclass(frozen=True, slots=True, eq=False)
class PointDistance:
    """Holds the pixels of two scene points by camera, and the distance between the points (mm)."""

    first: Mapping[str, Float[np.ndarray, " 2"]]
    second: Mapping[str, Float[np.ndarray, " 2"]]
    distance_mm: float


@dataclass(frozen=True, slots=True)
class TagSize:
    """Describes printed ArUco tags of one size (mm) and one dictionary of OpenCV."""

    dictionary: str
    size_mm: float


@dataclass(frozen=True, slots=True)
class CameraDistance:
    """Holds the distance (mm) between the centres of projection of two cameras."""

    cameras: tuple[str, str]
    distance_mm: float


KnownLength = PointDistance | TagSize | CameraDistance


def read_scale(path: Path, cameras: Collection[str]) -> KnownLength:
    """Reads ``scale.json`` for photographs by ``cameras``. Raises InputError naming every fault."""
    try:
        document = json.loads(path.read_bytes())  # UTF-8, 16 or 32, which json recognises by the first bytes
    except (OSError, ValueError, RecursionError) as error:
        raise InputError(path.name, [compose("no-json", reason=str(error))]) from error
    return scale_from_document(document, cameras, path.name)


def scale_from_document(document: Any, cameras: Collection[str], subject: str = "scale.json") -> KnownLength:
    """Returns the known length in a decoded ``scale.json``. Raises InputError naming every fault."""
    present = [kind for kind in KINDS if isinstance(document, dict) and kind in document]
    if len(present) != 1:
        several = compose("scale-kinds", kinds=KINDS, held=present)
        raise InputError(subject, [several if present else compose("scale-kind", kinds=KINDS)])
    faults: list[Message] = []
    unknown = sorted(set(document) - {present[0], "distance_mm"} - {"format"})
    faults += [compose("no-key-of-it", key=f"{key!r:.80}") for key in unknown]
    readers = {"points": _points, "tag": _tag, "cameras": _cameras}
    known = readers[present[0]](document, cameras, faults)
    if faults or known is None:
        raise InputError(subject, faults)
    return known


def _points(document: dict[str, Any], cameras: Collection[str], faults: list[Message]) -> PointDistance | None:
    distance = _length(document, "distance_mm", faults)
    points = document["points"]
    if not isinstance(points, dict) or len(points) != 2:
        faults.append(compose("scale-points"))
        return None
    ends = [_pixels(views, f"points.{printable(name):.80}", cameras, faults) for name, views in points.items()]
    first, second = ends
    shared = [name for name in first if name in second]
    # One alone may lie behind the other in one picture, in two it cannot.
    if len(shared) > 1 and all(np.array_equal(first[name], second[name]) for name in shared):
        named = [f"{printable(name):.80}" for name in points]
        faults.append(compose("scale-points-equal", points=named, cameras=shared))
    return PointDistance(first, second, distance)


def _pixels(views: Any, where: str, cameras: Collection[str], faults: list[Message]) -> dict[str, np.ndarray]:
    if not isinstance(views, dict) or len(views) < 2:
        faults.append(compose("scale-point-views", point=where))
        return {}
    for name, pixel in views.items():
        if name not in cameras:
            faults.append(compose("no-photograph-of", key=where, camera=f"{name!r:.80}"))
        listed = isinstance(pixel, list) and len(pixel) == 2
        if not listed or not all(is_number(at) and -1.0 < at < PIXELS_MOST for at in pixel):
            key = f"{where}.{printable(name):.80}"
            faults.append(compose("no-pixel-pair", key=key, value=f"{pixel!r:.80}", most=PIXELS_MOST))
    return {} if faults else {name: np.array(pixel, float) for name, pixel in views.items()}


def _tag(document: dict[str, Any], cameras: Collection[str], faults: list[Message]) -> TagSize | None:
    tag = document["tag"]
    if not isinstance(tag, dict):
        faults.append(compose("scale-tag"))
        return None
    unknown = sorted(set(tag) - {"dictionary", "size_mm"})
    faults += [compose("no-key-of-it", key=f"{'tag.' + key!r:.80}") for key in unknown]
    name = tag.get("dictionary")
    if not isinstance(name, str) or name not in dictionaries():
        faults.append(compose("tag-dictionary", name=f"{name!r:.80}"))
    return TagSize(str(name), _length(tag, "size_mm", faults, "tag."))


def dictionaries() -> dict[str, int]:
    """Returns OpenCV's predefined ArUco dictionaries by name."""
    import cv2

    return {name: getattr(cv2.aruco, name) for name in dir(cv2.aruco) if name.startswith("DICT_")}


def _cameras(document: dict[str, Any], cameras: Collection[str], faults: list[Message]) -> CameraDistance | None:
    distance = _length(document, "distance_mm", faults)
    names = document["cameras"]
    if not isinstance(names, list) or len(names) != 2 or names[0] == names[1]:
        faults.append(compose("scale-cameras"))
        return None
    strange = [name for name in names if name not in cameras]
    faults += [compose("no-photograph-of", key="cameras", camera=f"{name!r:.80}") for name in strange]
    return CameraDistance((names[0], names[1]), distance)


def _length(document: dict[str, Any], key: str, faults: list[Message], where: str = "") -> float:
    value: Any = document.get(key)
    if not is_number(value) or not 0.1 <= value <= 1e5:
        faults.append(compose("no-length", key=f"{where}{key}", value=f"{value!r:.80}"))
        return 1.0
    return float(value)
