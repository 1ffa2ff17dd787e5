"""Adds an animation of the node's pose and its morph targets' weights to a binary glTF file with one node.

https://registry.khronos.org/glTF/specs/2.0/glTF-2.0.html#animations"""

import json
import struct
from collections.abc import Sequence

import numpy as np
from jaxtyping import Float

from rig.formats.meshes.scene import quaternion
from rig.geometry import RigidTransform

FLOAT = 5126
HEADER, CHUNK = 12, 8  # bytes of the file's header and of a chunk's


def animated(
    glb: bytes, times_s: Float[np.ndarray, " t"], weights: Float[np.ndarray, "t m"], poses: Sequence[RigidTransform]
) -> bytes:
    """Returns the glTF file with an animation of its first node. ``weights`` are those of the mesh's morph targets, in
    their order; ``poses`` are in mm."""
    (length,) = struct.unpack_from("<I", glb, HEADER)
    document = json.loads(glb[HEADER + CHUNK : HEADER + CHUNK + length])
    payload = bytearray(glb[HEADER + CHUNK + length + CHUNK :])
    turns = np.stack([quaternion(pose.rotation) for pose in poses])
    for k in range(1, len(turns)):  # of q and -q, which turn alike, the one that is nearer
        if turns[k] @ turns[k - 1] < 0.0:
            turns[k] *= -1.0
    turns /= np.linalg.norm(turns, axis=1, keepdims=True)
    shifts = np.stack([pose.translation for pose in poses]) / 1000.0

    def append(values: Float[np.ndarray, "..."], kind: str) -> int:
        single = np.ascontiguousarray(values, "<f4")
        payload.extend(b"\0" * (-len(payload) % 4))
        document["bufferViews"].append({"buffer": 0, "byteOffset": len(payload), "byteLength": single.nbytes})
        payload.extend(single.tobytes())
        accessor = {"bufferView": len(document["bufferViews"]) - 1, "componentType": FLOAT, "count": len(single)}
        document["accessors"].append(accessor | {"type": kind})
        return len(document["accessors"]) - 1

    clock = append(times_s, "SCALAR")
    single = times_s.astype("<f4")
    document["accessors"][clock] |= {"min": [float(single.min())], "max": [float(single.max())]}
    outputs = {"rotation": append(turns, "VEC4"), "translation": append(shifts, "VEC3")}
    if weights.size:
        outputs["weights"] = append(weights.ravel(), "SCALAR")
    samplers = [{"input": clock, "output": output, "interpolation": "LINEAR"} for output in outputs.values()]
    channels = [{"sampler": k, "target": {"node": 0, "path": path}} for k, path in enumerate(outputs)]
    document["animations"] = [{"name": "sequence", "samplers": samplers, "channels": channels}]
    payload.extend(b"\0" * (-len(payload) % 4))
    document["buffers"][0]["byteLength"] = len(payload)
    text = json.dumps(document, separators=(",", ":")).encode()
    text += b" " * (-len(text) % 4)
    head = struct.pack("<4sII", b"glTF", 2, HEADER + 2 * CHUNK + len(text) + len(payload))
    parts = struct.pack("<I4s", len(text), b"JSON") + text + struct.pack("<I4s", len(payload), b"BIN\0")
    return head + parts + bytes(payload)
