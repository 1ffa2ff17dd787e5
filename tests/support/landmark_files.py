"""Writes landmark files as a program of other people writes them."""

import json
from collections.abc import Mapping
from pathlib import Path

import numpy as np
from jaxtyping import Float


def write_landmarks(path: Path, landmarks: Mapping[str, Float[np.ndarray, " 3"]]) -> None:
    """Writes landmarks in the ``.json`` form."""
    points = {name: [round(float(x), 4) for x in point] for name, point in landmarks.items()}
    path.write_text(json.dumps({"format": "eigenhead-landmarks/1", "points": points}, indent=1), encoding="utf-8")
