"""Takes shots with the simulated studio; runs in a child process, which keeps the renderer and the model."""

from dataclasses import replace
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np

from rig.progress import Progress
from server.storage.records import JsonObject
from server.tasks.child import WorkerContext

if TYPE_CHECKING:
    from rig.studio.scene.simulate import SimulatedCapture


def simulated(context: WorkerContext, report: Progress, *, folder: str, seed: int | None) -> JsonObject:
    """Takes a shot of the simulated studio: writes the capture to ``folder/files`` and the true head to
    ``folder/truth``. Returns the shot's certificate.

    Without a seed each shot shows another subject. The capture has no feature points, because operators pick them.
    """
    from pipeline.head_model.model import load_model
    from rig.formats.captures.capture_folder import write_capture
    from rig.render.renderer import Renderer
    from rig.studio.devices.folder import write_truth
    from rig.studio.scene.layout import default_layout
    from rig.studio.scene.simulate import simulate
    from rig.studio.sensor.preset import PRESET
    from server.tasks.subjects import drawn_subject

    model = context.keep("model", load_model)
    renderer = context.keep("renderer", Renderer.create)
    rng = np.random.default_rng(seed)
    taken = simulate(drawn_subject(model, rng), default_layout(), PRESET, rng, renderer=renderer)
    write_capture(Path(folder) / "files", replace(taken.capture, features={}), taken.rig)
    write_truth(Path(folder) / "truth", taken, seed=seed)
    return describe(taken)


def describe(taken: "SimulatedCapture") -> JsonObject:
    """Returns the sync certificate of a simulated shot, all of whose pictures show the same moment."""
    cameras = {name: {"status": "in sync", "skew_ms": 0.0} for name in taken.rig.names}
    faults = [f.kind if f.camera is None else f"{f.kind} in {f.camera}" for f in taken.faults]
    return {"kind": "simulated", "subject": taken.scene.name, "cameras": cameras, "faults": faults}


def look(context: WorkerContext, report: Progress, *, cameras: list[str]) -> dict[str, np.ndarray]:
    """Returns a picture (RGB) of each of the named cameras of the simulated studio, with fresh noise. The subject is
    the same in every call."""
    from pipeline.head_model.model import load_model
    from rig.render.renderer import Renderer
    from rig.studio.scene.layout import default_layout
    from rig.studio.scene.simulate import build_scene, view_light
    from rig.studio.sensor.preset import PRESET
    from rig.studio.sensor.sensor import expose
    from server.tasks.subjects import drawn_subject

    def scene() -> Any:
        rng = np.random.default_rng(1)
        model = context.keep("model", load_model)
        renderer = context.keep("renderer", Renderer.create)
        return build_scene(drawn_subject(model, rng), default_layout(), PRESET, rng, renderer=renderer)

    views, noise = context.keep("scene", scene).views, np.random.default_rng()
    return {name: expose(view_light(views[name]), views[name].sensor, noise) for name in cameras}
