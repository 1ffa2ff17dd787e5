"""Reads and writes flame_param.npz, the parameters of a FLAME head that VHAP writes and GaussianAvatars reads.

The file flame_param.npz is a NumPy archive of float32 arrays (https://github.com/ShenhanQian/VHAP,
https://github.com/ShenhanQian/GaussianAvatars). Lengths are in metres and rotation vectors in radians. The first axis
of the FLAME arrays is time. ``static_offset`` is added to each vertex before any joint rotates.
"""

import io
from collections.abc import Mapping
from pathlib import Path
from typing import Any

import numpy as np
from jaxtyping import Float, Float32

from rig.errors import InputError
from rig.formats.meshes.pickled_arrays import DAMAGE, open_npz
from rig.messages.message import compose

FILE = "flame_param.npz"
POSES = {"rotation": 3, "neck_pose": 3, "jaw_pose": 3, "eyes_pose": 6}
CANONICAL_JAW_RAD = 0.3  # canonical_flame_param.npz opens the mouth, so that lips do not stick together
FlameParam = Mapping[str, Float32[np.ndarray, "..."]]


def flame_param(
    shape: Float[np.ndarray, " s"],
    expression: Float[np.ndarray, " e"],
    pose: Float[np.ndarray, "5 3"],
    translation: Float[np.ndarray, " 3"],
    offsets: Float[np.ndarray, "v 3"],
) -> FlameParam:
    """Returns the arrays of flame_param.npz for one moment. ``pose`` holds rotations of root, neck, jaw and eyes."""
    parts = np.split(pose.ravel(), np.cumsum([*POSES.values()])[:-1])
    arrays = {"shape": shape, "expr": expression[None]}
    arrays |= {name: part[None] for name, part in zip(POSES, parts, strict=True)}
    arrays |= {"translation": translation[None], "static_offset": offsets[None]}
    return {name: array.astype(np.float32) for name, array in arrays.items()}


def canonical(parameters: FlameParam) -> FlameParam:
    """Returns a FLAME head's parameters at the origin, facing along z, without expression and with open mouth."""
    out = {name: array if name in ("shape", "static_offset") else 0.0 * array for name, array in parameters.items()}
    return out | {"jaw_pose": np.array([[CANONICAL_JAW_RAD, 0.0, 0.0]], np.float32)}


def encode_flame_param(parameters: FlameParam) -> bytes:
    """Encodes the arrays as the bytes of flame_param.npz."""
    packed = io.BytesIO()
    arrays: dict[str, Any] = dict(parameters)
    np.savez(packed, **arrays)
    return packed.getvalue()


def read_flame_param(path: Path) -> FlameParam:
    """Reads the arrays of a flame_param.npz with one moment. Raises InputError for a damaged file or other arrays."""
    try:
        with open_npz(path) as file:
            arrays = {name: file[name].astype(np.float32) for name in file}
    except (OSError, *DAMAGE) as fault:
        raise InputError(str(path), [compose("file-incomplete", reason=str(fault))]) from None
    wanted = POSES | {"translation": 3}
    faults = [
        compose("flame-array-unfit", name=name, shape=str(arrays[name].shape), wanted=f"(1, {size})")
        for name, size in wanted.items()
        if name in arrays and arrays[name].shape != (1, size)
    ]
    names = ("shape", "expr", *wanted, "static_offset")
    faults += [compose("flame-array-missing", name=name) for name in names if name not in arrays]
    if faults:
        raise InputError(str(path), faults)
    return {name: arrays[name] for name in names}
