"""Reads and writes point lists of 3D Slicer (``.mrk.json``, markups schema 1.0.3).

A point list states whether its axes are LPS (x to the patient's left, y to the back, z up) or RAS (x to the right, y to
the front, z up). A half turn about z converts between LPS and RAS axes. Lengths are in millimetres.
"""

import json
from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Any, Literal

import numpy as np
from jaxtyping import Float

from rig.errors import InputError
from rig.messages.message import compose

Axes = Literal["LPS", "RAS"]
AXES: tuple[Axes, ...] = ("LPS", "RAS")
RAS_FROM_LPS = np.diag([-1.0, -1.0, 1.0])  # its own inverse
SCHEMA = (
    "https://raw.githubusercontent.com/slicer/slicer/master/Modules/Loadable/Markups/Resources/Schema/"
    "markups-schema-v1.0.3.json#"
)


@dataclass(frozen=True, slots=True, eq=False)
class MarkupPoint:
    """Holds the position (mm), label and description of a point."""

    position: Float[np.ndarray, " 3"]
    description: str = ""


def axes_turn(wanted: Axes, held: Axes) -> Float[np.ndarray, "3 3"]:
    """Returns the rotation that converts coordinates from the axes ``held`` to the axes ``wanted``."""
    return np.eye(3) if wanted == held else RAS_FROM_LPS


def markups_document(points: Mapping[str, MarkupPoint], axes: Axes, name: str = "landmarks") -> dict[str, Any]:
    """Returns a point list as plain values for JSON. Positions (mm) must be in ``axes``."""
    controls = [
        {
            "id": str(number),
            "label": label,
            "description": point.description,
            "position": point.position.tolist(),
            "positionStatus": "defined",
        }
        for number, (label, point) in enumerate(points.items(), 1)
    ]
    markup = {
        "type": "Fiducial",
        "name": name,
        "coordinateSystem": axes,
        "coordinateUnits": "mm",
        "controlPoints": controls,
    }
    return {"@schema": SCHEMA, "markups": [markup]}


def read_markups(path: Path, axes: Axes) -> dict[str, Float[np.ndarray, " 3"]]:
    """Reads the points (mm) of all lists in a file by label, converted to ``axes``. Omits points without a position.
    Raises InputError."""
    found: dict[str, Float[np.ndarray, " 3"]] = {}
    turns: dict[str, Float[np.ndarray, "3 3"]] = {}
    try:
        for markup in json.loads(path.read_text(encoding="utf-8-sig"))["markups"]:
            turn = axes_turn(axes, AXES[AXES.index(markup.get("coordinateSystem", "LPS"))])
            for point in markup["controlPoints"]:
                if point.get("positionStatus", "defined") == "defined":
                    found[str(point["label"])] = np.array(point["position"], float).reshape(3)
                    turns[str(point["label"])] = turn
    except (OSError, ValueError, KeyError, TypeError, AttributeError) as error:
        raise InputError(path.name, [compose("markups-unread", reason=f"{type(error).__name__}: {error}")]) from error
    bad = [label for label, point in found.items() if not np.isfinite(point).all()]
    if bad or not found:
        fault = compose("markups-not-finite", names=", ".join(bad)) if bad else compose("markups-empty")
        raise InputError(path.name, [fault])
    return {label: turns[label] @ point for label, point in found.items()}
