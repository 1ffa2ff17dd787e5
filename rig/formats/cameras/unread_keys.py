"""Finds keys of ``cameras.json`` that are not read, such as a misspelt ``covarianse`` or a ``k4`` that the lens model
lacks.

They are no faults, because files may carry other programs' keys, but a warning tells the author that they have no
effect."""

import json
from collections import Counter
from collections.abc import Iterator, Mapping
from pathlib import Path
from typing import Any

from rig.formats.cameras.cameras_json import FORMAT
from rig.messages.message import Message, compose
from rig.recorded_lens import COEFFICIENTS

READ = {
    "": {"format", "unit", "cameras"},
    "cameras": {"name", "width", "height", "intrinsics", "distortion", "camera_from_world", "covariance", "serial"},
    "cameras.intrinsics": {"fx", "fy", "cx", "cy"},
    "cameras.camera_from_world": {"rotation", "translation"},
}
LENS_MODELS: dict[str, set[str]] = {
    "brown-conrady": {"model", "k1", "k2", "p1", "p2", "k3"},
    **{model: {"model", *keys} for model, keys in COEFFICIENTS.items()},
}
TOLD_MOST = 8  # keys named one by one; the others are counted


def unread_keys(path: Path) -> tuple[Message, ...]:
    """Returns a message for every key of ``cameras.json`` that is not read. Returns nothing for other programs' files,
    and for a file that cannot be parsed, which its reader refuses."""
    if path.suffix != ".json" or path.name == "transforms.json":
        return ()
    try:
        document = json.loads(path.read_text(encoding="utf-8-sig"))
    except (OSError, ValueError, RecursionError):
        return ()
    return unread_keys_of(document, path.name)


def unread_keys_of(document: Any, subject: str = "cameras.json") -> tuple[Message, ...]:
    """Returns messages for the keys of a decoded ``cameras.json`` that are not read; keys that many cameras share are
    reported once, with their number."""
    counts = Counter(_unread(document))
    faults = []
    for (place, key), times in list(counts.items())[:TOLD_MOST]:
        where = repr(f"{place}.{key}" if place else key)  # repr, since the key may contain unprintable characters
        faults.append(compose("key-unread", count=times, key=f"{where:.80}"))
    if len(counts) > TOLD_MOST:
        faults.append(compose("keys-unread-more", more=len(counts) - TOLD_MOST))
    return tuple(compose("located", where=subject, fault=fault) for fault in faults)


def _unread(document: Any) -> Iterator[tuple[str, str]]:
    """Yields the place and name of each key that is not read."""
    if not isinstance(document, Mapping) or document.get("format") != FORMAT:
        return
    yield from _beside(document, "")
    cameras = document.get("cameras")
    for camera in cameras if isinstance(cameras, list) else []:
        if isinstance(camera, Mapping):
            yield from _beside(camera, "cameras")
            yield from _beside(camera.get("intrinsics"), "cameras.intrinsics")
            yield from _beside(camera.get("camera_from_world"), "cameras.camera_from_world")
            lens = camera.get("distortion")
            if isinstance(lens, Mapping):
                known = LENS_MODELS.get(str(lens.get("model", "brown-conrady")), set(lens))  # others are refused
                yield from (("cameras.distortion", key) for key in lens if key not in known)


def _beside(entry: Any, place: str) -> Iterator[tuple[str, str]]:
    if isinstance(entry, Mapping):
        yield from ((place, key) for key in entry if key not in READ[place])
