"""Subjects of the simulated studio, and the capture folders that show them."""

from pathlib import Path

import numpy as np

from pipeline.eigenheads.correspondence.scans import landmark_file, read_landmarks
from pipeline.eigenheads.model import HeadModel, load_model
from rig.formats.mesh_file import read_mesh
from rig.mesh import Mesh
from rig.render.renderer import Renderer
from rig.studio.devices.folder import simulate_to_folder
from rig.studio.scene.layout import default_layout
from rig.studio.scene.simulate import simulate
from rig.studio.scene.subject import Subject
from rig.studio.sensor.faults import fault_from_text
from rig.studio.sensor.preset import Preset


def drawn_subject(model: HeadModel, rng: np.random.Generator) -> Subject:
    """A head drawn from the model's population, all modes."""
    return model_subject(model, rng.standard_normal(len(model.modes)), f"drawn from {model.name}")


def model_subject(model: HeadModel, coefficients: np.ndarray, name: str) -> Subject:
    full = model.levels["full"]
    vertices = model.vertices(coefficients)
    landmarks = {name: vertices[index] for name, index in model.landmarks.items()}
    return Subject(Mesh(vertices, full.faces), landmarks, full.face_region, name)


def subject_of(text: str, model: HeadModel, rng: np.random.Generator) -> Subject:
    """``random``, ``mean``, or a mesh file in the head frame (mm) with its landmarks beside it, where it has some.

    Raises InputError."""
    if text == "random":
        return drawn_subject(model, rng)
    if text == "mean":
        return model_subject(model, np.zeros(0), f"mean of {model.name}")
    path = Path(text)
    marks = landmark_file(path)
    return Subject(read_mesh(path), {} if marks is None else read_landmarks(marks), name=path.name)


def simulate_folder(
    out: Path, *, subject: str, seed: int, preset: Preset, faults: list[str], renderer: Renderer
) -> Path:
    """``eigenhead simulate``: a capture folder at ``out``; returns where the truth is."""
    rng = np.random.default_rng(seed)
    chosen = subject_of(subject, load_model(), rng)
    planted = tuple(fault_from_text(text) for text in faults)
    taken = simulate(chosen, default_layout(), preset, rng, renderer=renderer, faults=planted)
    return simulate_to_folder(out, taken, seed=seed)
