"""Reads and writes head models as files; ``pipeline.head_model.model`` holds a model in memory."""

import hashlib
import json
from collections.abc import Mapping
from dataclasses import dataclass, field
from io import BytesIO
from pathlib import Path

import numpy as np
from jaxtyping import Bool, Float, Float32, Int

from pipeline.head_model.expressions import Expressions, no_expressions, packed, unpacked
from rig.errors import EigenheadError
from rig.files import write_atomically
from rig.formats.meshes.pickled_arrays import DAMAGE, open_npz

FORMAT = "eigenhead-model/2"  # 2: with expressions
READABLE = ("eigenhead-model/1", FORMAT)


class BadModel(EigenheadError):
    """Reports a file that is damaged or is not a head model of this project."""

    def __init__(self, path: Path | str, why: str) -> None:
        super().__init__(
            f"{path} cannot be used as a head model: {why}. A foreign model is read by `eigenhead model import`"
        )


class Damaged(BadModel):
    """Reports a model file with a missing or unreadable part."""

    def __init__(self, path: Path | str, fault: Exception) -> None:
        super().__init__(path, f"damaged or incomplete ({fault})")


@dataclass(frozen=True, slots=True, eq=False)
class ModelParts:
    """Holds the content of a model file. ``pipeline.head_model.model.assemble`` builds a HeadModel from these parts."""

    name: str
    licence: str
    source: str
    notice: str
    subjects: Mapping[str, int]
    mean: Float[np.ndarray, "V0 3"]
    modes: Float[np.ndarray, "M V0 3"]
    sigma: Float[np.ndarray, " M"]
    landmarks: Mapping[str, int]
    faces: Int[np.ndarray, "F 3"]  # of the cage
    face_region: Bool[np.ndarray, " V0"]
    subdivisions: int
    decimated: Mapping[str, tuple[Int[np.ndarray, " K"], Int[np.ndarray, "G 3"]]]  # rows of full, faces
    figures: Mapping[str, float] = field(default_factory=dict)
    scores: Float[np.ndarray, "N C"] = field(default_factory=lambda: np.zeros((0, 0), np.float32))
    expressions: Expressions | None = None


def save_model(path: Path, parts: ModelParts) -> None:
    """Writes a model file (compressed npz, float32). Lengths are rounded to 2^-12 mm, which compresses well."""
    expressions = parts.expressions or no_expressions(len(parts.mean))
    meta = {
        "format": FORMAT,
        "expressions": list(expressions.names),
        "name": parts.name,
        "licence": parts.licence,
        "source": parts.source,
        "notice": parts.notice,
        "subjects": dict(parts.subjects),
        "landmarks": {k: int(v) for k, v in parts.landmarks.items()},
        "subdivisions": parts.subdivisions,
        "figures": {k: round(float(v), 6) for k, v in parts.figures.items()},
    }
    arrays = {
        "meta": np.frombuffer(json.dumps(meta, sort_keys=True).encode(), np.uint8),
        "mean": rounded(parts.mean),
        "modes": rounded(parts.modes),
        "sigma": np.asarray(parts.sigma, np.float32),
        "faces": np.asarray(parts.faces, np.int32),
        "face_region": np.packbits(parts.face_region),
        "scores": np.asarray(parts.scores, np.float32),
        **packed(expressions),
    }
    for name, (rows, faces) in parts.decimated.items():
        arrays[f"{name}_rows"], arrays[f"{name}_faces"] = np.asarray(rows, np.int32), np.asarray(faces, np.int32)
    packed_arrays = BytesIO()
    np.savez_compressed(packed_arrays, **arrays)
    write_atomically(path, packed_arrays.getvalue())


def rounded(values: np.ndarray) -> Float32[np.ndarray, "..."]:
    """Returns lengths (mm) rounded to 2^-12 mm, the precision of a model file."""
    return (np.round(np.asarray(values, float) * 4096) / 4096).astype(np.float32)


def read_parts(path: Path) -> tuple[ModelParts, str]:
    """Returns the content of a model file and its SHA-256. Raises BadModel if the model file cannot be used."""
    try:
        raw = path.read_bytes()
    except OSError as fault:
        raise BadModel(path, fault.strerror or "cannot be read") from None
    try:
        with open_npz(BytesIO(raw)) as file:
            if "meta" not in file:
                raise BadModel(path, "it does not carry this project's model format")
            meta = json.loads(file["meta"].tobytes())
            if meta.get("format") not in READABLE:
                raise BadModel(path, f"format {meta.get('format')!r}, wanted {FORMAT!r}")
            parts = _parts(meta, file)
    except (OSError, *DAMAGE) as fault:
        raise Damaged(path, fault) from None
    return parts, hashlib.sha256(raw).hexdigest()


def expression_names(path: Path) -> tuple[str, ...]:
    """Returns the names of the expressions in a model file without reading their displacements. Raises BadModel."""
    try:
        with open_npz(path) as file:
            return tuple(json.loads(file["meta"].tobytes()).get("expressions", ()))
    except (OSError, *DAMAGE) as fault:
        raise Damaged(path, fault) from None


def _parts(meta: dict, file: Mapping[str, np.ndarray]) -> ModelParts:
    mean = file["mean"]
    return ModelParts(
        name=meta["name"],
        licence=meta["licence"],
        source=meta["source"],
        notice=meta["notice"],
        subjects=meta["subjects"],
        mean=mean,
        modes=file["modes"],
        sigma=file["sigma"],
        landmarks=meta["landmarks"],
        faces=file["faces"],
        face_region=np.unpackbits(file["face_region"], count=len(mean)).astype(bool),
        subdivisions=meta["subdivisions"],
        decimated={name: (file[f"{name}_rows"], file[f"{name}_faces"]) for name in ("p95", "p99")},
        figures=meta["figures"],
        scores=file["scores"],
        expressions=unpacked(meta["expressions"], file, len(mean)) if meta.get("expressions") else None,
    )
