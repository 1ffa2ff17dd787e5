"""Chooses which views are compared: their directions must differ enough to determine depth, but not so much that
windows no longer match."""

from collections.abc import Sequence

import numpy as np
from jaxtyping import Float, Int

from pipeline.settings import DenseSettings
from rig.camera import Camera


def choose_neighbours(
    cameras: Sequence[Camera], at_world: Float[np.ndarray, " 3"], settings: DenseSettings
) -> list[Int[np.ndarray, " _"]]:
    """Returns, for each camera, the indices of the cameras to match it with, by increasing angle between their lines of
    sight; empty if there are none.

    Args:
        cameras: of all views.
        at_world: about the middle of the subject (mm), where the lines of sight meet.
        settings: limits of the angle and of the number.
    """
    towards = np.stack([camera.centre_world - at_world for camera in cameras])
    towards /= np.maximum(np.linalg.norm(towards, axis=1, keepdims=True), 1e-9)
    angle = np.degrees(np.arccos(np.clip(towards @ towards.T, -1.0, 1.0)))
    chosen = []
    for row in angle:
        order = [k for k in np.argsort(row, kind="stable") if settings.angle_least_deg < row[k]]
        kept = [
            k
            for place, k in enumerate(order)
            if row[k] < settings.angle_most_deg
            or (place < settings.neighbours_least and row[k] < settings.angle_widest_deg)
        ]
        chosen.append(np.array(kept[: settings.neighbours_most], dtype=np.int64))
    return chosen
