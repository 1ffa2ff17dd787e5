"""Describes a head model, as ``eigenhead model info --json`` prints it."""

from typing import Any

from pipeline.head_model.model import HeadModel


def model_info(model: HeadModel) -> dict[str, Any]:
    """Returns the description of a model as JSON types. ``vertices`` and ``faces`` are those of the full level; figures
    that were never measured are None."""
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
