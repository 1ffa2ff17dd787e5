"""Describes a head model, as ``eigenhead model info --json`` prints it."""

from collections.abc import Mapping
from typing import TypedDict

from pipeline.head_model.model import HeadModel


class LevelInfo(TypedDict):
    """Describes the size of a mesh level."""

    vertices: int
    faces: int


class ModelInfo(TypedDict):
    """Describes a head model. ``vertices`` and ``faces`` are those of the full level; figures that were never measured
    are None."""

    name: str
    licence: str
    sha256: str
    subjects: dict[str, int]
    modes: int
    expressions: list[str]
    vertices: int
    faces: int
    landmarks: int
    generalisation_mm: float | None
    specificity_mm: float | None
    source: str
    notice: str
    figures: Mapping[str, object]
    levels: dict[str, LevelInfo]


def model_info(model: HeadModel) -> ModelInfo:
    """Returns the description of a model as JSON types."""
    full = model.levels["full"]
    return {
        "name": model.name,
        "licence": model.licence,
        "sha256": model.sha256,
        "subjects": dict(model.subjects),
        "modes": len(model.modes),
        "expressions": list(model.expressions.names),
        "vertices": full.count,
        "faces": len(full.faces),
        "landmarks": len(model.landmarks),
        "generalisation_mm": model.figures.get("generalisation_mm"),
        "specificity_mm": model.figures.get("specificity_mm"),
        "source": model.source,
        "notice": model.notice,
        "figures": dict(model.figures),
        "levels": {
            name: {"vertices": level.count, "faces": len(level.faces)} for name, level in sorted(model.levels.items())
        },
    }
