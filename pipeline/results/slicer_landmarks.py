"""``landmarks.mrk.json``: the landmarks of a result as a point list of 3D Slicer (markups, schema 1.0.3).

Enters: a reconstruction, whose landmarks are in the world frame (mm). Leaves: the document, in the patient's axes LPS
(to the left, posterior, superior; mm) with the head frame's origin and true size. The head frame is x to the subject's
left, y up, z out of the face, so that a point (x, y, z) of it is (x, -z, y).
"""

import math
from typing import Any

import numpy as np

from pipeline.evidence.measurements import Landmark
from pipeline.results.reconstruction import Reconstruction
from rig.geometry import RigidTransform

SCHEMA = (
    "https://raw.githubusercontent.com/slicer/slicer/master/Modules/Loadable/Markups/Resources/Schema/"
    "markups-schema-v1.0.3.json#"
)
LPS_FROM_HEAD = np.array([[1.0, 0.0, 0.0], [0.0, 0.0, -1.0], [0.0, 1.0, 0.0]])


def landmarks_document(result: Reconstruction) -> dict[str, Any]:
    """Returns the point list as JSON types, with one control point for each landmark."""
    place = result.head.fit.world_from_head
    head_from_world = RigidTransform(place.rotation, place.translation).inverse()  # keeps the size, as head.glb does
    lps_from_world = RigidTransform(LPS_FROM_HEAD, np.zeros(3)) @ head_from_world
    points = [
        {
            "id": str(number),
            "label": name,
            "description": _uncertainty(landmark),
            "position": lps_from_world.apply(landmark.position_mm).tolist(),
            "positionStatus": "defined",
        }
        for number, (name, landmark) in enumerate(result.evidence.landmarks.items(), 1)
    ]
    markup = {
        "type": "Fiducial",
        "name": "landmarks",
        "coordinateSystem": "LPS",
        "coordinateUnits": "mm",
        "controlPoints": points,
    }
    return {"@schema": SCHEMA, "markups": [markup]}


def _uncertainty(landmark: Landmark) -> str:
    """Returns the standard deviation as text: that of the distance, which no rotation changes, and those of the three
    world coordinates, as in report.json."""
    std = landmark.std_mm
    if std is None:
        return "standard deviation unknown"
    x, y, z = (float(value) for value in std)
    return f"standard deviation {math.hypot(x, y, z):.3f} mm; of world x {x:.3f}, y {y:.3f}, z {z:.3f} mm"
