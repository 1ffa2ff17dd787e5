"""A binary glTF taken apart into its JSON document and its buffer, and put together again."""

import json
import struct
from collections.abc import Sequence
from typing import Any

import numpy as np


def opened_glb(glb: bytes) -> tuple[dict[str, Any], bytearray]:
    """Returns the document and the buffer of a GLB of this project."""
    (length,) = struct.unpack_from("<I", glb, 12)
    return json.loads(glb[20 : 20 + length]), bytearray(glb[28 + length :])


def closed_glb(document: dict[str, Any], payload: Sequence[int] | bytearray) -> bytes:
    """Encodes a document and its one buffer as a GLB."""
    data = bytes(payload) + b"\0" * (-len(payload) % 4)
    document["buffers"] = [{"byteLength": len(data)}]
    text = json.dumps(document, separators=(",", ":")).encode()
    text += b" " * (-len(text) % 4)
    header = struct.pack("<4sII", b"glTF", 2, 28 + len(text) + len(data))
    return header + struct.pack("<I4s", len(text), b"JSON") + text + struct.pack("<I4s", len(data), b"BIN\0") + data


def appended_view(document: dict[str, Any], payload: bytearray, array: np.ndarray, target: int | None = None) -> int:
    """Appends an array to the buffer and returns the index of its view. ``target``: glTF's number of what it is for."""
    payload.extend(b"\0" * (-len(payload) % 4))
    view = {"buffer": 0, "byteOffset": len(payload), "byteLength": array.nbytes}
    document["bufferViews"].append(view | ({} if target is None else {"target": target}))
    payload.extend(array.tobytes())
    return len(document["bufferViews"]) - 1
