"""Caches the silhouettes of a capture on disk, for jobs with other settings and for the operator's pages.

A file's name is the SHA-256 of everything that its content depends on: the capture's files and the code. Cached
silhouettes equal those that ``segment`` returned bit for bit. Silhouettes show a face: ``Store.remove_capture`` erases
them. An unreadable cached file is made again. Silhouettes that cannot be written are not cached.
"""

import dataclasses
import hashlib
import io
import json
import os
import zipfile
import zlib
from contextlib import suppress
from importlib.metadata import version
from pathlib import Path

import cv2
import numpy as np
from jaxtyping import Float32

from pipeline.imaging.silhouette import Silhouette, ViewQuality
from pipeline.segmentation.segment import segment
from rig.capture import Capture
from rig.files import write_atomically
from rig.messages.message import documents_of, read_message
from rig.progress import Progress
from rig.rig import Rig
from server.storage.face_cache import code_digest

SUFFIX = ".silhouettes"
ROOMS = (
    ".",
    "faces",
    "geometry",
    "imaging",
    "multiview",
    "segmentation",
    "segmentation/without_plates",
)  # of the pipeline: what silhouettes come from
QUICK = 1  # zlib's fastest level: 35 MB become 4.7 MB in 0.2 s, and no level gets below 4


def segment_once(folder: Path, capture: Capture, rig: Rig, *, report: Progress) -> dict[str, Silhouette]:
    """Returns the silhouettes of a capture. Silhouettes that ``folder`` has from an earlier call are read; others are
    computed by ``segment`` and stored there. The capture must have been read from files."""
    path = folder / (_key(capture) + SUFFIX)
    with suppress(OSError, ValueError, KeyError, zipfile.BadZipFile, zlib.error):
        found = _decoded(path.read_bytes())
        os.utime(path)  # what was used last is dropped last
        report("segmentation", 1.0)
        return found
    found = segment(capture, rig, report=report)
    with suppress(OSError):
        write_atomically(path, _encoded(found))
    return found


def _key(capture: Capture) -> str:
    inputs = {name: digest for name, digest in capture.digests.items() if name != "features.json"}
    sizes = {name: image.shape for name, image in capture.images.items()}  # large pictures are read smaller
    document = [inputs, sizes, version("eigenhead"), cv2.__version__, code_digest(ROOMS)]
    return hashlib.sha256(json.dumps(document, sort_keys=True).encode()).hexdigest()


def _encoded(silhouettes: dict[str, Silhouette]) -> bytes:
    arrays: dict[str, np.ndarray] = {}
    documents = []
    for number, (name, silhouette) in enumerate(silhouettes.items()):
        quality = silhouette.quality
        messages = {"warnings": documents_of(quality.warnings), "doubts": documents_of(quality.doubts)}
        plain = dataclasses.asdict(dataclasses.replace(quality, warnings=(), doubts=()))
        documents.append({"name": name, **plain, **messages})
        arrays[f"shape{number}"] = np.array(silhouette.mask.shape)
        arrays[f"mask{number}"] = _bytes(zlib.compress(np.packbits(silhouette.mask).tobytes(), QUICK))
        arrays[f"distance{number}"] = _bytes(zlib.compress(_steps(silhouette.distance), QUICK))
    stream = io.BytesIO()
    # A zip file, which tells damage by its CRC.
    np.savez(stream, allow_pickle=False, views=_bytes(json.dumps(documents).encode()), **arrays)
    return stream.getvalue()


def _decoded(data: bytes) -> dict[str, Silhouette]:
    found: dict[str, Silhouette] = {}
    with np.load(io.BytesIO(data), allow_pickle=False) as arrays:
        for number, view in enumerate(json.loads(arrays["views"].tobytes())):
            height, width = (int(size) for size in arrays[f"shape{number}"])
            packed = np.frombuffer(zlib.decompress(arrays[f"mask{number}"].tobytes()), np.uint8)
            mask = np.unpackbits(packed, count=height * width).reshape(height, width).view(bool)
            distance = _from_steps(zlib.decompress(arrays[f"distance{number}"].tobytes()), height, width)
            name = view.pop("name")
            messages = {field: tuple(map(read_message, view[field])) for field in ("warnings", "doubts")}
            listed = {"cut_off": tuple(view["cut_off"]), **messages}
            found[name] = Silhouette(mask, distance, ViewQuality(**view | listed))
    return found


def _steps(values: Float32[np.ndarray, "h w"]) -> bytes:
    """Returns differences of bit patterns along rows, highest bytes first: distances rise evenly, so the differences
    compress well."""
    bits = np.ascontiguousarray(values).view(np.int32)
    return np.diff(bits, axis=1, prepend=np.int32(0)).view(np.uint8).reshape(-1, 4).T.tobytes()


def _from_steps(data: bytes, height: int, width: int) -> Float32[np.ndarray, "h w"]:
    steps = np.ascontiguousarray(np.frombuffer(data, np.uint8).reshape(4, -1).T).view(np.int32).reshape(height, width)
    return np.cumsum(steps, axis=1, dtype=np.int32).view(np.float32)


def _bytes(data: bytes) -> np.ndarray:
    return np.frombuffer(data, np.uint8)
