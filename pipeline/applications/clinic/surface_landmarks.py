"""Reads landmarks that somebody marked on a patient's surface: in 3D Slicer, or in the forms that scans have."""

from pathlib import Path

import numpy as np
from jaxtyping import Float

from pipeline.applications.clinic.registration import MIN_MARKS
from pipeline.applications.model_building.correspondence.scans import plain_name, read_landmarks
from pipeline.head_model.landmarks import NAMES
from rig.errors import InputError
from rig.formats.meshes.markups import Axes, read_markups
from rig.messages.message import compose


def read_surface_landmarks(path: Path, axes: Axes) -> dict[str, Float[np.ndarray, " 3"]]:
    """Returns landmarks by this project's names, in the surface's axes. A .mrk.json states its own axes; any other form
    is in the surface's. Raises InputError, also for fewer than ``MIN_MARKS`` known ones."""
    if path.name.lower().endswith(".mrk.json"):
        named = {plain_name(label): point for label, point in read_markups(path, axes).items()}
        known = {name: point for name, point in named.items() if name in NAMES}
    else:
        known = read_landmarks(path)
    if len(known) < MIN_MARKS:
        raise InputError(path.name, [compose("marks-too-few", found=len(known), needed=MIN_MARKS)])
    return known
