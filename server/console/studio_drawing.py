"""Draws the live view of the simulated studio, in a separate child process, so that a shot does not stop the live view.

The studio is drawn once; each picture adds only new sensor noise. To be fast, the cameras use binning, as real cameras
do for a live view. From time to time one camera is exposed at full size to measure its sharpness.
"""

from dataclasses import replace

import cv2
import numpy as np

from pipeline.head_model.model import load_model
from rig.formats.pictures.images import encode_image
from rig.render.renderer import Renderer
from rig.studio.scene.layout import default_layout
from rig.studio.scene.simulate import Scene, build_scene, view_light
from rig.studio.sensor.preset import PRESET
from rig.studio.sensor.sensor import Sensor, expose
from server.console.live_frame import measured_frame
from server.storage.records import JsonObject
from server.tasks.child import WorkerContext
from server.tasks.subjects import drawn_subject

WIDTH = 320
SHARP_EVERY = 5  # looks between two exposures at full size, which cost as much as a look
QUALITY = 78
QUICK = replace(PRESET, samples=1)  # the pictures are shown at a third of their size, which smooths edges enough
SUBJECT_SEED = 1  # the same person as in the rig's own previews


def frames(context: WorkerContext, look: int) -> list[JsonObject]:
    """Returns the present picture of each camera of the simulated studio. ``look`` counts the calls: every
    ``SHARP_EVERY``-th call also measures one camera's blur."""
    views = context.keep("live", _draw)
    rng = context.keep("noise", np.random.default_rng)
    names = list(views)
    sharp = names[look // SHARP_EVERY % len(names)] if look % SHARP_EVERY == 0 else None
    return [_frame(name, view, rng, sharp=name == sharp) for name, view in views.items()]


def _draw() -> dict[str, tuple[Sensor, np.ndarray, np.ndarray]]:
    rng = np.random.default_rng(SUBJECT_SEED)
    subject = drawn_subject(load_model(), rng)
    with Renderer.create() as renderer:
        scene: Scene = build_scene(subject, default_layout(), QUICK, rng, renderer=renderer)
    pictures = {}
    for name, view in scene.views.items():
        light = view_light(view)
        height = round(light.shape[0] * WIDTH / light.shape[1])
        small = cv2.resize(light, (WIDTH, height), interpolation=cv2.INTER_AREA)
        pictures[name] = (view.sensor, light.astype(np.float16), small)  # 11 bits hold an 8-bit picture
    return pictures


def _frame(
    name: str, lit: tuple[Sensor, np.ndarray, np.ndarray], rng: np.random.Generator, *, sharp: bool
) -> JsonObject:
    sensor, light, small = lit
    picture = expose(small, sensor, rng)
    data = encode_image(".jpg", picture, (cv2.IMWRITE_JPEG_QUALITY, QUALITY))
    large = expose(light.astype(np.float32), sensor, rng) if sharp else None
    return measured_frame(name, picture, data, large)
