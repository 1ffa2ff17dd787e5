"""Where the eyes look, and how far the pupils stand apart, of irises that were found (``faces.irises``).

The far pupil distance is that between the pupils when both eyes look straight ahead at a point infinitely far away (ISO
13666). Both then lie the same way in front of the points about which the eyes turn: it is the distance between the
centres of the eyeballs, whatever the eyes looked at when they were photographed.
"""

from collections.abc import Mapping

import numpy as np
from jaxtyping import Float

from pipeline.evidence.measurements import Measurement
from pipeline.faces.irises import Iris, UnseenEye

PUPIL_DISTANCE = "pupil_distance"


def pupils(eyes: Mapping[str, Iris | UnseenEye]) -> dict[str, Measurement]:
    """Returns the far pupil distance by its name among the measurements; nothing where there is none."""
    found = pupil_distance(eyes)
    return {} if found is None else {PUPIL_DISTANCE: found}


def pupil_distance(eyes: Mapping[str, Iris | UnseenEye]) -> Measurement | None:
    """Returns the far pupil distance (mm), None unless both irises were found."""
    right, left = eyes.get("right"), eyes.get("left")
    if not isinstance(right, Iris) or not isinstance(left, Iris):
        return None
    apart = left.eyeball - right.eyeball
    value = float(np.linalg.norm(apart))
    variance = sum(
        along @ iris.covariance @ along for iris in (right, left) for along in [apart / value @ iris.eyeball_jacobian]
    )
    return Measurement(value, float(np.sqrt(variance)))


def angles_deg(direction: Float[np.ndarray, " 3"]) -> tuple[float, float]:
    """Returns azimuth (from z towards x) and elevation (from there towards y) of a unit vector, degrees. In the head
    frame these are to the subject's left, and up."""
    x, y, z = direction
    return float(np.degrees(np.arctan2(x, z))), float(np.degrees(np.arcsin(np.clip(y, -1.0, 1.0))))
