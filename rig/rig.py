"""Defines a rig: calibrated cameras with names."""

from collections.abc import Callable, Iterable, Iterator
from dataclasses import dataclass, replace

import numpy as np
from jaxtyping import Float

from rig.camera import Camera, Intrinsics
from rig.errors import EigenheadError
from rig.geometry import nearest_to_rays
from rig.messages.message import compose


class UnknownCamera(EigenheadError, KeyError):
    """Reports a name that no camera of the rig has. The class is also a KeyError."""

    def __init__(self, name: str, names: tuple[str, ...]) -> None:
        known = compose("rig-cameras", cameras=names) if names else compose("rig-empty")
        super().__init__(compose("rig-camera-unknown", camera=f"{name!r}", known=known))

    def __str__(self) -> str:
        return str(self.args[0])  # KeyError's own would put it in quotes


@dataclass(frozen=True, slots=True, eq=False)
class Rig:
    """Holds cameras in the order of their file. ``scale_sigma`` is the relative standard deviation of all lengths of
    the rig, if its scale was estimated from photographs."""

    cameras: tuple[Camera, ...]
    scale_sigma: float = 0.0

    def __len__(self) -> int:
        return len(self.cameras)

    def __iter__(self) -> Iterator[Camera]:
        return iter(self.cameras)

    def __getitem__(self, name: str) -> Camera:
        """Returns the camera with the given name. Raises UnknownCamera if no camera has it."""
        for camera in self.cameras:
            if camera.name == name:
                return camera
        raise UnknownCamera(name, self.names)

    def __contains__(self, name: object) -> bool:
        return any(camera.name == name for camera in self.cameras)

    @property
    def names(self) -> tuple[str, ...]:
        """Returns the cameras' names, in the order of their file."""
        return tuple(camera.name for camera in self.cameras)

    def subset(self, names: Iterable[str]) -> "Rig":
        """Returns a rig of only the cameras ``names``, in the order of the rig."""
        retained = set(names)
        return replace(self, cameras=tuple(camera for camera in self.cameras if camera.name in retained))

    def with_intrinsics(self, change: Callable[[Intrinsics], Intrinsics]) -> "Rig":
        """Returns the rig with each camera's intrinsics replaced by the result of ``change``."""
        return replace(self, cameras=tuple(replace(c, intrinsics=change(c.intrinsics)) for c in self.cameras))

    def scaled(self, factor: float) -> "Rig":
        """Returns the rig with intrinsics for images scaled by ``factor``."""
        cameras = (replace(camera, intrinsics=camera.intrinsics.scaled(factor)) for camera in self.cameras)
        return replace(self, cameras=tuple(cameras))

    def centre_world(self) -> Float[np.ndarray, " 3"]:
        """Returns the point (mm) nearest to all optical axes by least squares, where the subject should be."""
        centres = np.stack([camera.centre_world for camera in self.cameras])
        return nearest_to_rays(centres, np.stack([camera.axis_world for camera in self.cameras]))

    def front_camera(self) -> str:
        """Returns the name of the middle camera, whose direction is nearest to the mean of all directions."""
        directions = np.stack([camera.centre_world for camera in self.cameras]) - self.centre_world()
        directions /= np.linalg.norm(directions, axis=1, keepdims=True)
        return self.cameras[int(np.argmax(directions @ directions.mean(axis=0)))].name


def spread_views(rig: Rig, count: int) -> list[str]:
    """Returns the names of at most ``count`` cameras with widely different views. The front camera comes first. Each
    further camera is the one whose direction from the subject is farthest from all chosen cameras (Gonzalez,
    *Clustering to minimize the maximum intercluster distance*, 1985)."""
    away = np.stack([camera.centre_world for camera in rig]) - rig.centre_world()
    away /= np.linalg.norm(away, axis=1, keepdims=True)
    chosen = [rig.names.index(rig.front_camera())]
    nearest = away @ away[chosen[0]]
    while len(chosen) < min(count, len(rig)):
        nearest[chosen] = np.inf
        chosen.append(int(np.argmin(nearest)))
        nearest = np.maximum(nearest, away @ away[chosen[-1]])
    return [rig.names[index] for index in chosen]
