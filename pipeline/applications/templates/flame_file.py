"""Reads a FLAME model from the file that its licence gives: .pkl as it is published, or an .npz of the same arrays.

Nothing that a pickle names is run (``rig.formats.meshes.pickled_arrays``). ``shapedirs`` holds the modes of shape
first; there are 300 of them in every published version, and the others are of expression.
"""

from collections.abc import Iterable, Mapping
from pathlib import Path

import numpy as np

from pipeline.applications.templates.flame_model import JOINTS, FlameModel
from pipeline.applications.templates.header import DAMAGE
from rig.errors import InputError
from rig.formats.meshes.pickled_arrays import read_pickled_arrays
from rig.messages.message import Message, compose

SUFFIXES = (".pkl", ".npz")
SHAPES = 300  # modes of shape at the beginning of shapedirs
NAMES = ("v_template", "shapedirs", "posedirs", "J_regressor", "weights", "kintree_table", "f")


def read_flame(path: Path) -> FlameModel:
    """Returns the model in a file. Raises InputError that lists every fault."""
    arrays = read_pickled_arrays(path) if path.suffix.lower() == ".pkl" else _archive(path)
    faults = [compose("flame-array-missing", name=name) for name in NAMES if name not in arrays]
    faults = faults or [*_unfit(arrays)] or [*_not_finite(arrays)]
    if faults:
        raise InputError(path.name, faults)
    modes = arrays["shapedirs"].astype(float)
    parents = arrays["kintree_table"][0].astype(np.int64)  # the root's own is 2^32 - 1 in published files
    parents[0] = -1
    return FlameModel(
        template=arrays["v_template"].astype(float),
        shape_modes=modes[:, :, :SHAPES],
        expression_modes=modes[:, :, SHAPES:],
        pose_modes=arrays["posedirs"].astype(float),
        joint_regressor=arrays["J_regressor"].astype(float),
        weights=arrays["weights"].astype(float),
        parents=parents,
        faces=arrays["f"].astype(np.int32),
    )


def _archive(path: Path) -> dict[str, np.ndarray]:
    try:
        with np.load(path, allow_pickle=False) as file:
            return {name: file[name] for name in NAMES if name in file}
    except (OSError, *DAMAGE) as fault:
        raise InputError(path.name, [compose("file-incomplete", reason=str(fault))]) from None


def _unfit(arrays: Mapping[str, np.ndarray]) -> Iterable[Message]:
    """Returns a fault for each array whose shape is not the model's."""
    count = len(arrays["v_template"]) if arrays["v_template"].ndim else 0
    wanted = {
        "v_template": (count, 3),
        "posedirs": (count, 3, 9 * (JOINTS - 1)),
        "J_regressor": (JOINTS, count),
        "weights": (count, JOINTS),
        "kintree_table": (2, JOINTS),
    }
    for name, shape in wanted.items():
        if arrays[name].shape != shape:
            yield compose("flame-array-unfit", name=name, shape=str(arrays[name].shape), wanted=str(shape))
    modes, faces = arrays["shapedirs"].shape, arrays["f"].shape
    if len(modes) != 3 or modes[:2] != (count, 3) or modes[2] <= SHAPES:
        yield compose("flame-array-unfit", name="shapedirs", shape=str(modes), wanted=f"({count}, 3, {SHAPES} + ...)")
    if len(faces) != 2 or faces[1] != 3:
        yield compose("flame-array-unfit", name="f", shape=str(faces), wanted="(..., 3)")


def _not_finite(arrays: Mapping[str, np.ndarray]) -> Iterable[Message]:
    count = len(arrays["v_template"])
    above, faces = arrays["kintree_table"][0, 1:].astype(np.int64), arrays["f"].astype(np.int64)
    bad = {
        "kintree_table": not ((above >= 0) & (above < np.arange(1, JOINTS))).all(),
        "f": not len(faces) or faces.min() < 0 or faces.max() >= count,
    }
    for name in NAMES:
        if bad.get(name, False) or not np.isfinite(arrays[name].astype(float)).all():
            yield compose("flame-not-finite", name=name)
