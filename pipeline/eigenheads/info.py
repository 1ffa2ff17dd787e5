"""What a head model is made of, as ``eigenhead model info --json`` says it."""

from typing import Any

from pipeline.eigenheads.model import HeadModel


def model_info(model: HeadModel) -> dict[str, Any]:
    """Plain values. Vertices and faces are the full level's; what nobody measured is None."""
    full = model.levels["full"]
    return {
        "name": model.name,
        "licence": model.licence,
        "sha256": model.sha256,
        "subjects": dict(model.subjects),
        "modes": len(model.modes),
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
