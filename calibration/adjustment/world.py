"""Chooses the world frame of a calibrated rig: x to the subject's left, y up, z towards the front camera.

Up is the direction perpendicular to the cameras' image rows: a camera that is not rolled has a horizontal x axis at any
elevation. The origin is the point nearest to all optical axes."""

from dataclasses import replace

import numpy as np
from jaxtyping import Float

from rig.errors import InputError
from rig.geometry import RigidTransform
from rig.messages.message import compose
from rig.rig import Rig


def up_direction(rig: Rig) -> Float[np.ndarray, " 3"]:
    """Returns the unit vector that points up, in the rig's present frame."""
    rights = np.stack([camera.camera_from_world.rotation[0] for camera in rig])
    ups = -np.stack([camera.camera_from_world.rotation[1] for camera in rig])
    values, vectors = np.linalg.eigh(rights.T @ rights)
    mean = ups.mean(axis=0)
    # Two small eigenvalues: all rows are parallel, so a whole plane of directions is perpendicular to them.
    spread = vectors[:, :1] if values[1] > 0.05 * values[2] else vectors[:, :2]
    up = spread @ (spread.T @ mean)
    return up / np.linalg.norm(up)


def in_world_frame(rig: Rig, front: str | None = None) -> Rig:
    """Returns the same rig in the project's world frame. ``front`` names the front camera; by default it is the middle
    one.

    Covariances are those of left perturbations and do not change. Raises InputError if ``front`` is no camera of the
    rig."""
    if front is not None and front not in rig:
        raise InputError("front camera", [compose("front-of-other-rig", front=f"{front!r}", cameras=rig.names)])
    origin, up = rig.centre_world(), up_direction(rig)
    forward = rig[front or rig.front_camera()].centre_world - origin
    forward = forward - up * (up @ forward)
    forward /= np.linalg.norm(forward)
    new_from_old = np.stack([np.cross(up, forward), up, forward])
    old_from_new = RigidTransform(new_from_old.T, origin)
    return Rig(tuple(replace(camera, camera_from_world=camera.camera_from_world @ old_from_new) for camera in rig))
