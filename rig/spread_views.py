"""Chooses a few of many views that stand well apart."""

import numpy as np

from rig.rig import Rig


def spread_views(rig: Rig, count: int) -> list[str]:
    """Returns the names of at most ``count`` cameras that stand well apart: the front one first, then always the one
    whose direction from the subject is farthest from all chosen (Gonzalez, *Clustering to minimize the maximum
    intercluster distance*, 1985)."""
    away = np.stack([camera.centre_world for camera in rig]) - rig.centre_world()
    away /= np.linalg.norm(away, axis=1, keepdims=True)
    chosen = [rig.names.index(rig.front_camera())]
    nearest = away @ away[chosen[0]]
    while len(chosen) < min(count, len(rig)):
        nearest[chosen] = np.inf
        chosen.append(int(np.argmin(nearest)))
        nearest = np.maximum(nearest, away @ away[chosen[-1]])
    return [rig.names[index] for index in chosen]
