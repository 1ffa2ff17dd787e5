"""Lists the board pictures of a folder by camera and shot: ``IMAGES/<camera>/<shot>.<ext>``.

Many programs instead make a folder for each shot, with a file for each camera. The names of files usually reveal such a
structure. If names do not, the pictures reveal the structure, because a fixed camera sees the same room in every shot.
"""

from collections.abc import Mapping, Sequence
from itertools import combinations
from pathlib import Path
from typing import TypeVar

import cv2
import numpy as np
from jaxtyping import UInt8

from rig.errors import InputError
from rig.formats.cameras.cameras_json import name_fault
from rig.formats.pictures.picture_names import PLAIN_SUFFIXES, WORD
from rig.messages.message import Message, compose, say_once

SUFFIXES = (".png", ".jpg", ".jpeg", ".tif", ".tiff", ".webp", *PLAIN_SUFFIXES)
CAMERA_WORDS = ("cam", "camera", "kamera", "left", "right")  # with which names of cameras begin
COMPARED = 4  # folders, and files of each, whose pictures are compared
UNLIKE = 4.0  # times as much between files of a folder as between those of one name: 27 in a rig that stands still, 2.5
# where people held the cameras; 1 / 27 where folders are cameras
MIN_DIFFERENCE = 1.0  # levels: less is a picture's noise

Filed = Mapping[str, Mapping[str, Path]]
_Thing = TypeVar("_Thing")


def list_pictures(folder: Path, *, together: bool = True) -> dict[str, dict[str, Path]]:
    """Returns the pictures of a folder as {camera: {shot: path}}. ``together`` requires cameras to share shots. Raises
    an InputError that names every fault."""
    if not folder.is_dir():
        raise InputError(str(folder), [compose("no-picture-folder")])
    faults, filed = list[Message](), dict[str, dict[str, Path]]()
    for inner in sorted(entry for entry in folder.iterdir() if entry.is_dir() and not entry.name.startswith(".")):
        paths = sorted(path for path in inner.iterdir() if path.suffix.lower() in SUFFIXES and path.is_file())
        if not paths:
            continue
        filed[inner.name] = {path.stem: path for path in paths}
        doubled = len(filed[inner.name]) < len(paths)
        faults += [compose("camera-with-double-shot", camera=inner.name)] if doubled else []
    cameras = _turned(filed) if _are_shots(filed) else filed
    faults += [compose("camera-rename", fault=fault) for name in cameras if (fault := name_fault(name))]
    if not cameras:
        faults.append(compose("no-pictures"))
    faults += _named_apart(cameras) if together else []
    if faults:
        raise InputError(str(folder.name), say_once(faults, cameras))
    return cameras


def _named_apart(cameras: Filed) -> list[Message]:
    """Returns a fault if no two cameras have a shot of the same name, for example where cameras number files."""
    shots = [shot for files in cameras.values() for shot in files]
    if len(cameras) < 2 or len(set(shots)) < len(shots):
        return []
    (one, first), (other, second), *_ = cameras.items()
    return [compose("shots-named-apart", camera=one, shot=min(first), other=other, other_shot=min(second))]


def filed_by_shot(pictures: Filed) -> bool:
    """Returns whether the pictures from ``list_pictures`` lie in folders of shots instead of folders of cameras."""
    return any(path.parent.name != camera for camera, shots in pictures.items() for path in shots.values())


def _turned(filed: Filed) -> dict[str, dict[str, Path]]:
    turned: dict[str, dict[str, Path]] = {}
    for outer, files in filed.items():
        for inner, path in files.items():
            turned.setdefault(inner, {})[outer] = path
    return dict(sorted(turned.items()))


def _are_shots(filed: Filed) -> bool:
    """Returns whether each folder is a shot and each file in it a camera."""
    shared = set.intersection(*(set(files) for files in filed.values())) if filed else set()
    if len(filed) < 2 or len(shared) < 2:
        return False
    if any(map(_names_camera, filed)):
        return False
    if all(map(_names_camera, shared)):
        return True
    return _difference(filed) > UNLIKE * _difference(_turned(filed))


def _names_camera(name: str) -> bool:
    words = WORD.findall(name.casefold())
    return bool(words) and words[0] in CAMERA_WORDS


def _difference(filed: Filed) -> float:
    """Returns the median difference (grey levels) between a group's pictures, or infinity if their sizes differ."""
    differences = []
    for files in _spread([*filed.values()]):
        pictures = [picture for path in _spread([*files.values()]) if (picture := _small(path)) is not None]
        for one, other in combinations(pictures, 2):
            differences.append(float(np.median(cv2.absdiff(one, other))) if one.shape == other.shape else np.inf)
    return max(float(np.median(differences)), MIN_DIFFERENCE) if differences else MIN_DIFFERENCE


def _spread(things: Sequence[_Thing]) -> list[_Thing]:
    """Returns a few elements at even steps from first to last."""
    return [things[k] for k in np.unique(np.linspace(0, len(things) - 1, COMPARED).round().astype(int))]


def _small(path: Path) -> UInt8[np.ndarray, "h w"] | None:
    try:
        return cv2.imdecode(np.frombuffer(path.read_bytes(), np.uint8), cv2.IMREAD_REDUCED_GRAYSCALE_8)
    except (OSError, cv2.error):
        return None
