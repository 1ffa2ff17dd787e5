"""Fewer cameras of a rig: the most frontal ones, and those that stand evenly in a circle.

Directions are those of the cameras from the head, in its own frame: azimuth from the face towards the subject's left,
elevation upwards.
"""

from collections.abc import Sequence

import numpy as np
from jaxtyping import Float

from rig.geometry import Similarity
from rig.rig import Rig

MAX_GAP_DEG = 80.0  # between neighbours of a full circle: five cameras stand 72 degrees apart, five of 24 up to 75


def directions_from_head(rig: Rig, world_from_head: Similarity) -> Float[np.ndarray, "n 3"]:
    """Computes the unit vector from the head to each camera, head frame."""
    head_from_world = world_from_head.inverse()
    found = np.array([head_from_world.apply(camera.centre_world) for camera in rig])
    return found / np.linalg.norm(found, axis=1, keepdims=True)


def azimuths_deg(rig: Rig, world_from_head: Similarity) -> Float[np.ndarray, " n"]:
    """Computes where each camera stands around the head."""
    x, _, z = directions_from_head(rig, world_from_head).T
    return np.degrees(np.arctan2(x, z))


def frontal_views(rig: Rig, world_from_head: Similarity, count: int) -> tuple[str, ...]:
    """Returns the ``count`` cameras that look at the face most frontally, in the rig's order."""
    facing = directions_from_head(rig, world_from_head)[:, 2]
    return _names(rig, np.argsort(-facing, kind="stable")[:count].tolist())


def even_views(rig: Rig, world_from_head: Similarity, count: int) -> tuple[str, ...]:
    """Returns ``count`` cameras spread evenly over a circle's azimuths, the most frontal one among them."""
    azimuth = np.radians(azimuths_deg(rig, world_from_head))
    around = np.argsort(azimuth, kind="stable")
    first = int(np.argmin(np.abs(azimuth[around])))
    places = [(first + round(i * len(around) / count)) % len(around) for i in range(count)]
    return _names(rig, [int(around[place]) for place in places])


def is_circle(rig: Rig, world_from_head: Similarity) -> bool:
    """Tells whether cameras stand all around the head."""
    azimuth = np.sort(azimuths_deg(rig, world_from_head))
    return bool(np.diff(azimuth, append=azimuth[0] + 360.0).max() <= MAX_GAP_DEG)


def _names(rig: Rig, rows: Sequence[int]) -> tuple[str, ...]:
    return tuple(rig.names[row] for row in sorted(rows))
