"""Defines what readers of other projects' models return, and the error that they raise."""

from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path

import numpy as np
from jaxtyping import Float, Int

from pipeline.head_model.expressions import Expressions
from rig.errors import EigenheadError


class CannotImport(EigenheadError):
    """Reports a file or folder that contains no readable head model."""

    def __init__(self, path: Path | str, why: str) -> None:
        super().__init__(
            f"{path} cannot be imported as a head model: {why}. Readable are ICT-FaceKit (its repository or compact "
            "npz), statismo or Basel HDF5 files, and npz files with mean, modes, faces and landmarks (docs/models.md)"
        )


@dataclass(frozen=True, slots=True, eq=False, kw_only=True)
class Foreign:
    """Holds a model as its file describes it, in mm and the axes of the head frame (x to the subject's left, y up, z
    out of the face)."""

    name: str
    licence: str
    source: str
    notice: str
    mean: Float[np.ndarray, "V 3"]
    modes: Float[np.ndarray, "M V 3"]  # mm per standard deviation; need not be orthogonal
    faces: Int[np.ndarray, "F 3"]
    landmarks: Mapping[str, int]  # those that are known
    subjects: Mapping[str, int]
    expressions: Expressions | None = None  # displacements in mm


def read_obj(path: Path, *, polygons: bool = True) -> tuple[Float[np.ndarray, "V 3"], list[list[int]]]:
    """Returns vertices and polygons in the order of the file. trimesh would merge and reorder the vertices to which
    published indices refer."""
    vertices, faces = [], []
    with path.open(encoding="utf-8", errors="replace") as file:
        for line in file:
            if line.startswith("v "):
                vertices.append(line.split()[1:4])
            elif polygons and line.startswith("f "):
                faces.append([int(corner.split("/")[0]) - 1 for corner in line.split()[1:]])
    return np.array(vertices, float), faces
