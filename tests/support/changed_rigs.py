"""Rigs of which the poses or the intrinsics of all cameras, or of those that are named, were changed."""

from collections.abc import Callable
from dataclasses import replace

from rig.camera import Intrinsics
from rig.geometry import RigidTransform
from rig.rig import Rig


def reposed(rig: Rig, change: Callable[[RigidTransform], RigidTransform], *names: str) -> Rig:
    """Returns the rig with what ``change`` makes of camera_from_world."""
    chosen = names or rig.names
    return Rig(tuple(replace(c, camera_from_world=change(c.camera_from_world)) if c.name in chosen else c for c in rig))


def relensed(rig: Rig, change: Callable[[Intrinsics], Intrinsics], *names: str) -> Rig:
    """Returns the rig with what ``change`` makes of the intrinsics."""
    chosen = names or rig.names
    return Rig(tuple(replace(c, intrinsics=change(c.intrinsics)) if c.name in chosen else c for c in rig))
