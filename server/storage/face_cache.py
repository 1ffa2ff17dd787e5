"""Caches the faces found in a capture on disk, so that the pages search each capture once.

A file's name is the SHA-256 of everything that its content depends on: the capture's files, the program's version and
code. A cached file describes a face, so it lies in a folder that ``Store.remove_capture`` erases with its capture, even
while a search runs. A cached file that cannot be read is made anew. A result that cannot be written is not cached.
"""

import hashlib
import json
from collections.abc import Callable, Mapping
from contextlib import suppress
from functools import cache
from importlib.metadata import version
from pathlib import Path

import cv2

from rig.files import write_atomically
from server.storage.records import JsonObject

PIPELINE = Path(__file__).resolve().parents[2] / "pipeline"
ROOMS = ("alignment", "faces", "geometry", "head_model", "multiview")
SUFFIX = ".faces.json"

PixelsOfPoints = dict[str, dict[str, list[float]]]  # by landmark and camera, as features.json has them


def faces_once(folder: Path, inputs: Mapping[str, str], find: Callable[[], JsonObject]) -> JsonObject:
    """Returns the faces of a capture. If ``folder`` has the faces from an earlier call, ``find`` is not called;
    otherwise the result of ``find`` is stored there. ``inputs``: SHA-256 of the capture's files by name."""
    with suppress(OSError):
        folder.mkdir(parents=True, exist_ok=True)
    path = folder / (_key(inputs) + SUFFIX)
    with suppress(OSError, ValueError):
        document = json.loads(path.read_bytes())
        if isinstance(document, dict) and document.keys() == {"faces", "suggested"}:
            return document
    found = find()
    with suppress(OSError):
        write_atomically(path, json.dumps(found, separators=(",", ":")).encode(), parents=False)
    return found


def _key(inputs: Mapping[str, str]) -> str:
    files = {name: digest for name, digest in sorted(inputs.items()) if name != "features.json"}
    document = [files, version("eigenhead"), cv2.__version__, code_digest(ROOMS)]
    return hashlib.sha256(json.dumps(document).encode()).hexdigest()


@cache
def code_digest(rooms: tuple[str, ...]) -> str:
    """Returns the SHA-256 of all code in the named folders (paths below ``pipeline``), which is part of a cached file's
    name, so that new code invalidates the cache. Each process computes the hash once."""
    digest = hashlib.sha256()
    for path in sorted(path for room in rooms for path in (PIPELINE / room).glob("*.py")):
        digest.update(path.read_bytes())
    return digest.hexdigest()
