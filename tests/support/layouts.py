"""Provides arrangements of cameras beside the default one: the paper's, rows and circles."""

from collections.abc import Sequence

import numpy as np

from rig.rig import Rig
from rig.studio.scene.layout import rig_from_directions

# Section 5.3: azimuth 0 to 90 degrees, mirrored, and elevation -40 to 40. The paper shows the four only as pictures.
ARRANGEMENTS_DEG = {
    "a": ((0, 0), (-30, 0), (60, 0), (-90, 0), (0, 38), (30, 38), (-60, 38), (90, 38), (0, -38), (45, -38), (-90, -38)),
    "b": ((0, 0), (0, 30), (0, -30), (-40, 12), (45, -12), (50, 28), (-45, -28), (85, 6),
          (-90, -8), (-80, 20), (78, -22)),
    "c": ((0, -40), (0, -20), (0, 0), (0, 20), (0, 40), (-20, -30), (20, -10), (-20, 10), (20, 30), (28, 0), (-10, 0)),
    "d": ((0, 0), (-30, 0), (50, 20), (-55, -20), (65, 0), (-72, 30), (75, -30), (-80, 8),
          (85, 25), (-88, -15), (90, 0)),
}  # fmt: skip


def arrangement(name: str) -> Rig:
    """Returns a rig of section 5.3 of the paper: "a" even, "b" informative, "c" vertical, "d" to the side."""
    return rig_from_directions(ARRANGEMENTS_DEG[name])


def row_directions(count: int, spacing_mm: float, distance_mm: float) -> tuple[tuple[float, float], ...]:
    """Computes the directions (azimuth, elevation in degrees) of a level row of cameras in front of the face, from the
    subject's right to its left."""
    offsets = spacing_mm * (np.arange(count) - (count - 1) / 2)
    return tuple((float(np.degrees(np.arctan2(offset, distance_mm))), 0.0) for offset in offsets)


def circle_directions(count: int, elevations_deg: Sequence[float] = (0.0,)) -> tuple[tuple[float, float], ...]:
    """Computes the directions (azimuth, elevation in degrees) of cameras on a full circle, cam00 at the front.
    Successive cameras take the elevations in turn."""
    azimuths = (np.arange(count) * 360.0 / count + 180.0) % 360.0 - 180.0
    return tuple((float(azimuth), elevations_deg[i % len(elevations_deg)]) for i, azimuth in enumerate(azimuths))
