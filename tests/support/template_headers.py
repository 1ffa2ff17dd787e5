"""Template files that hold what is read before a job begins, and no mesh."""

import json
from pathlib import Path

import numpy as np

from pipeline.applications.templates.header import FORMAT
from pipeline.head_model.model_names import model_path, model_sha256

FIGURES = {
    "vertices": 5023.0,
    "skin_share": 0.78,
    "face_covered_share": 0.99,
    "unlike_median_mm": 0.31,
    "unlike_p95_mm": 1.22,
    "off_median_mm": 0.012,
    "off_p95_mm": 0.094,
}


def header_file(data: Path, name: str, **changed: str) -> Path:
    """A template of the data folder that the default model carries, or what is ``changed`` of it."""
    path = data / "templates" / f"{name}.npz"
    meta = {
        "format": FORMAT,
        "name": name,
        "source": f"{name}.obj",
        "source_sha256": "cd" * 32,
        "model_name": "makehuman-138",
        "model_sha256": model_sha256(model_path("default")),
        "figures": FIGURES,
    }
    path.parent.mkdir(parents=True, exist_ok=True)
    np.savez_compressed(path, meta=np.frombuffer(json.dumps(meta | changed).encode(), np.uint8))
    return path
