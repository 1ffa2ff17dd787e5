"""Chooses the world frame of a rig whose cameras were held upright, on their side or upside down."""

from dataclasses import replace

import numpy as np

from calibration.adjustment.world import in_world_frame
from pipeline.multiview.upright import quarter_turns
from rig.geometry import RigidTransform
from rig.rig import Rig

QUARTER = np.array([[0.0, -1.0, 0.0], [1.0, 0.0, 0.0], [0.0, 0.0, 1.0]])  # about the optical axis


def in_guessed_frame(rig: Rig, front: str | None) -> Rig:
    """Returns the rig in a guessed world frame, as ``in_world_frame`` would choose it with all cameras upright. Cameras
    held on their side or upside down are turned for the guess alone."""
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
