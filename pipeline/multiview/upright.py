"""Estimates the upward direction from the poses of cameras that were held upright, on their side or upside down.

If a camera is rolled only by quarter turns, the upward direction is nearly along one of its image axes and
perpendicular to the other axis. The estimate uses the poses alone and does not examine the pictures."""

import numpy as np
from jaxtyping import Float, Int

from rig.rig import Rig


def quarter_turns(rig: Rig) -> Int[np.ndarray, " c"]:
    """Returns by how many quarter turns each camera's image must be rotated to be upright."""
    axes = _image_axes(rig)
    return np.argmin(_downs(axes) @ _nearest_up(rig, axes), axis=1)


def guessed_up(rig: Rig) -> Float[np.ndarray, " 3"]:
    """Returns the upward direction (unit vector, world frame): the mean over all photographs, each rotated upright."""
    downs = _downs(_image_axes(rig))[np.arange(len(rig)), quarter_turns(rig)]
    up = -downs.mean(axis=0)
    return up / max(float(np.linalg.norm(up)), 1e-9)


def _image_axes(rig: Rig) -> Float[np.ndarray, "c 2 3"]:
    """Returns the x and y axes of each image as unit vectors in the world frame."""
    return np.stack([camera.camera_from_world.rotation[:2] for camera in rig])


def _downs(axes: Float[np.ndarray, "c 2 3"]) -> Float[np.ndarray, "c 4 3"]:
    """Returns the downward axis of each image (world frame) after 0, 1, 2 and 3 quarter turns."""
    return np.stack([axes[:, 1], axes[:, 0], -axes[:, 1], -axes[:, 0]], axis=1)


def _nearest_up(rig: Rig, axes: Float[np.ndarray, "c 2 3"]) -> Float[np.ndarray, " 3"]:
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
