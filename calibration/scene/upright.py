"""Which way is up, where photographs were held upright, on their side or upside down.

A camera that is not rolled by anything but quarter turns has its rows or its columns level, so up is nearly along one
of its two image axes and across the other. That is a guess: floors and faces are not looked at.
"""

from dataclasses import replace

import numpy as np
from jaxtyping import Float, Int

from calibration.adjustment.world import in_world_frame
from rig.geometry import RigidTransform
from rig.rig import Rig

QUARTER = np.array([[0.0, -1.0, 0.0], [1.0, 0.0, 0.0], [0.0, 0.0, 1.0]])  # about the optical axis


def in_guessed_frame(rig: Rig, front: str | None) -> Rig:
    """``in_world_frame`` of the rig as if every camera had been held upright."""
    turns = [np.linalg.matrix_power(QUARTER, int(count)) for count in quarter_turns(rig)]
    upright = Rig(
        tuple(
            replace(camera, camera_from_world=RigidTransform(turn, np.zeros(3)) @ camera.camera_from_world)
            for camera, turn in zip(rig, turns, strict=True)
        )
    )
    return Rig(
        tuple(
            replace(camera, camera_from_world=RigidTransform(turn.T, np.zeros(3)) @ camera.camera_from_world)
            for camera, turn in zip(in_world_frame(upright, front), turns, strict=True)
        )
    )


def quarter_turns(rig: Rig) -> Int[np.ndarray, " c"]:
    """By how many quarter turns each camera's frame must be turned for up to be up in its image."""
    axes = np.stack([camera.camera_from_world.rotation[:2] for camera in rig])  # x and y of each image, in the world
    up = _up(rig, axes)
    # After k quarter turns the image's y axis is that of k = 0, 1, 2, 3: y, x, -y, -x; up is against it.
    downs = np.stack([axes[:, 1], axes[:, 0], -axes[:, 1], -axes[:, 0]], axis=1)
    return np.argmin(downs @ up, axis=1)


def _up(rig: Rig, axes: Float[np.ndarray, "c 2 3"]) -> Float[np.ndarray, " 3"]:
    candidates = axes.reshape(-1, 3)
    along = np.abs(axes @ candidates.T)
    best = candidates[int(np.argmax((along.max(axis=1) - along.min(axis=1)).sum(axis=0)))]
    by_axis = axes @ best
    held = np.abs(by_axis[:, 1]) > np.abs(by_axis[:, 0])  # upright or upside down
    votes = float(-np.sign(by_axis[held, 1]).sum())
    if votes == 0:  # all on their side: more cameras look down at a subject than up
        origin = rig.centre_world()
        votes = float(sum((camera.centre_world - origin) @ best for camera in rig))
    return best if votes >= 0 else -best
