"""``landmarks.mrk.json``: the landmarks of a result as a point list of 3D Slicer.

Enters: a reconstruction, whose landmarks are in the world frame (mm). Leaves: the document, in the patient's axes LPS
(to the left, posterior, superior; mm) with the head frame's origin and true size. The head frame is x to the subject's
left, y up, z out of the face, so that a point (x, y, z) of it is (x, -z, y).
"""

import math
from typing import Any

import numpy as np
from jaxtyping import Float

from pipeline.results.reconstruction import Reconstruction
from rig.formats.meshes.markups import MarkupPoint, markups_document
from rig.geometry import RigidTransform

LPS_FROM_HEAD = np.array([[1.0, 0.0, 0.0], [0.0, 0.0, -1.0], [0.0, 1.0, 0.0]])


def landmarks_document(result: Reconstruction) -> dict[str, Any]:
    """Returns the point list as JSON types, with one control point for each landmark."""
    place = result.head.fit.world_from_head
    head_from_world = RigidTransform(place.rotation, place.translation).inverse()  # keeps the size, as head.glb does
    lps_from_world = RigidTransform(LPS_FROM_HEAD, np.zeros(3)) @ head_from_world
    points = {
        name: MarkupPoint(lps_from_world.apply(landmark.position_mm), uncertainty(landmark.std_mm))
        for name, landmark in result.evidence.landmarks.items()
    }
    return markups_document(points, "LPS")


def uncertainty(std_mm: Float[np.ndarray, " 3"] | None) -> str:
    """Returns the standard deviation as text: that of the distance, which no rotation changes, and those of the three
    world coordinates, as in report.json."""
    if std_mm is None:
        return "standard deviation unknown"
    x, y, z = (float(value) for value in std_mm)
    return f"standard deviation {math.hypot(x, y, z):.3f} mm; of world x {x:.3f}, y {y:.3f}, z {z:.3f} mm"
