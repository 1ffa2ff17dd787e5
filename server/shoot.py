"""Taking a shot with the simulated studio; runs in a child process, which keeps the renderer and the model."""

from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np

from pipeline.eigenheads.model import HeadModel, load_model
from rig.capture import write_capture
from rig.mesh import Mesh
from rig.mesh_files import read_mesh
from rig.render.renderer import Renderer
from rig.studio.faults import fault_from_text
from rig.studio.folder import simulate_to_folder, write_truth
from rig.studio.layout import default_layout
from rig.studio.preset import PRESET, Preset
from rig.studio.simulate import SimulatedCapture, simulate
from rig.studio.subject import Subject
from server.child import Bench, Report


def simulated(bench: Bench, report: Report, *, folder: str, seed: int | None) -> dict[str, Any]:
    """A capture in ``folder/files``, its truth in ``folder/truth``; returns the shot's certificate.

    Without a seed the subject is another one each time. The operator's clicks are left out: they are made later.
    """
    model = bench.keep("model", load_model)
    renderer = bench.keep("renderer", Renderer.create)
    rng = np.random.default_rng(seed)
    taken = simulate(drawn_subject(model, rng), default_layout(), PRESET, rng, renderer=renderer)
    write_capture(Path(folder) / "files", replace(taken.capture, features={}), taken.rig)
    write_truth(Path(folder) / "truth", taken, seed=seed)
    return describe(taken)


def describe(taken: SimulatedCapture) -> dict[str, Any]:
    """The certificate of a simulated shot: every picture is of one moment."""
    cameras = {name: {"status": "in sync", "skew_ms": 0.0} for name in taken.rig.names}
    faults = [f.kind if f.camera is None else f"{f.kind} in {f.camera}" for f in taken.faults]
    return {"kind": "simulated", "subject": taken.scene.name, "cameras": cameras, "faults": faults}


def drawn_subject(model: HeadModel, rng: np.random.Generator) -> Subject:
    """A head drawn from the model's population, all modes."""
    return model_subject(model, rng.standard_normal(len(model.modes)), f"drawn from {model.name}")


def model_subject(model: HeadModel, coefficients: np.ndarray, name: str) -> Subject:
    full = model.levels["full"]
    vertices = model.vertices(coefficients)
    landmarks = {name: vertices[index] for name, index in model.landmarks.items()}
    return Subject(Mesh(vertices, full.faces), landmarks, full.face_region, name)


def subject_of(text: str, model: HeadModel, rng: np.random.Generator) -> Subject:
    """``random``, ``mean``, or a mesh file in the head frame (mm). Raises InputError."""
    if text == "random":
        return drawn_subject(model, rng)
    if text == "mean":
        return model_subject(model, np.zeros(0), f"mean of {model.name}")
    return Subject(read_mesh(Path(text)), name=Path(text).name)


def simulate_folder(
    out: Path, *, subject: str, seed: int, preset: Preset, faults: list[str], renderer: Renderer
) -> Path:
    """``eigenhead simulate``: a capture folder at ``out``; returns where the truth is."""
    rng = np.random.default_rng(seed)
    chosen = subject_of(subject, load_model(), rng)
    planted = tuple(fault_from_text(text) for text in faults)
    taken = simulate(chosen, default_layout(), preset, rng, renderer=renderer, faults=planted)
    return simulate_to_folder(out, taken, seed=seed)


def look(bench: Bench, report: Report, *, cameras: list[str]) -> dict[str, np.ndarray]:
    """What cameras of the studio show (RGB): a subject that sits there, drawn once and kept."""
    from rig.studio.sensor import expose
    from rig.studio.simulate import build_scene, view_light

    def scene() -> Any:
        rng = np.random.default_rng(1)
        model = bench.keep("model", load_model)
        renderer = bench.keep("renderer", Renderer.create)
        return build_scene(drawn_subject(model, rng), default_layout(), PRESET, rng, renderer=renderer)

    views, noise = bench.keep("scene", scene).views, np.random.default_rng()
    return {name: expose(view_light(views[name]), views[name].sensor, noise) for name in cameras}
