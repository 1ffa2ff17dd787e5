"""Folders of results that hold what clinics, certificates, exports and pages read of them."""

import json
from pathlib import Path
from typing import Any

import numpy as np
from jaxtyping import Float, UInt8

from pipeline.head_model.model import load_model
from rig.formats.meshes.ply import write_ply
from rig.mesh import Mesh


def write_head(
    folder: Path,
    mesh: Mesh,
    quality_mm: float | Float[np.ndarray, " v"] = 0.1,
    colours: UInt8[np.ndarray, "v 3"] | None = None,
) -> Path:
    """Writes a mesh (mm) as the head of a result, grey where no colours are named. Returns the folder."""
    count = len(mesh.vertices)
    colours = np.full((count, 3), 150, np.uint8) if colours is None else colours
    quality, views = np.broadcast_to(np.float32(quality_mm), count), np.ones(count, np.uint8)
    write_ply(folder / "head.ply", mesh, normals=mesh.normals(), colours=colours, quality=quality, views=views)
    return folder


def mean_head_result(folder: Path, mesh: Mesh, **report: Any) -> Path:
    """Writes what a reconstruction leaves of the default model's vertices, wherever ``mesh`` has them."""
    model = load_model()
    write_head(folder, mesh)
    places = {name: mesh.vertices[row].tolist() for name, row in model.landmarks.items()}
    document = {
        "model": {"name": model.name, "sha256": model.sha256},
        "landmarks": {name: {"position": place, "std": [1.0, 2.0, 2.0]} for name, place in places.items()},
        "world_from_head": {"scale": 1.0, "rotation": np.eye(3).tolist(), "translation": [0.0, 0.0, 0.0]},
        "warnings": [],
    }
    (folder / "report.json").write_text(json.dumps(document | report))
    return folder
