"""Takes single pictures of a studio scene for simulated cameras."""

import itertools
import threading
from functools import lru_cache
from pathlib import Path
from typing import Protocol, runtime_checkable

import numpy as np
from jaxtyping import Float

from rig.formats.meshes.mesh_file import read_mesh
from rig.image import ImageRgb
from rig.render.renderer import Renderer
from rig.studio.scene.layout import default_layout
from rig.studio.scene.simulate import Scene, build_scene, view_light
from rig.studio.scene.subject import Subject
from rig.studio.sensor.preset import PRESET
from rig.studio.sensor.sensor import drift, expose


@runtime_checkable
class ImageSource(Protocol):
    """Declares a function that takes a picture with a simulated camera, sensor noise included."""

    def __call__(self, camera: str, time_s: float) -> ImageRgb:
        """Returns the named camera's picture at ``time_s``, in seconds since the studio began."""
        ...


class SceneImages:
    """Takes pictures of a static scene with or without the subject. Every simulated picture has different noise. Any
    thread may call the image source.

    The light differs between pictures with and without the subject by the drift in the scene's preset.
    """

    def __init__(self, scene: Scene, *, seated: bool, seed: int = 0) -> None:
        self._scene = scene
        self._seated = seated
        self._seed = seed
        self._takes = itertools.count()
        self._light: dict[str, Float[np.ndarray, "h w 3"]] = {}
        self._busy = threading.Lock()

    def __call__(self, camera: str, time_s: float) -> ImageRgb:
        """Takes one picture with the named camera. The studio scene is static, so ``time_s`` has no effect."""
        with self._busy:
            rng = np.random.default_rng((self._seed, next(self._takes)))
            light = self._light.get(camera)
        if light is None:
            light = self._light[camera] = self._lit(camera)
        return expose(light, self._scene.views[camera].sensor, rng)

    def _lit(self, camera: str) -> Float[np.ndarray, "h w 3"]:
        light = view_light(self._scene.views[camera], subject=self._seated)
        if not self._seated:
            return light
        rng = np.random.default_rng((self._seed, self._scene.rig.names.index(camera)))
        return light * drift(light.shape[:2], self._scene.preset.light_drift, rng)


_building = threading.Lock()


def scene_of_file(mesh_file: Path) -> Scene:
    """Returns the default studio with the head of a mesh file (head frame, mm). The last studio is cached.

    Raises InputError for a file that is not a mesh.
    """
    with _building:
        return _scene_of_file(mesh_file.resolve())


@lru_cache(maxsize=1)
def _scene_of_file(mesh_file: Path) -> Scene:
    subject = Subject(read_mesh(mesh_file), name=mesh_file.stem)
    with Renderer.create() as renderer:
        return build_scene(subject, default_layout(), PRESET, np.random.default_rng(0), renderer=renderer)
