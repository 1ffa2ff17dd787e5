"""Makes subjects of the simulated studio, and capture folders that show them."""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from types import MappingProxyType

import numpy as np

from pipeline.applications.model_building.correspondence.scans import landmark_file, read_landmarks
from pipeline.head_model.expressions import closed_lids, weights_from_text
from pipeline.head_model.model import HeadModel, load_model
from rig.errors import InputError
from rig.formats.meshes.mesh_file import read_mesh
from rig.mesh import Mesh
from rig.messages.message import compose
from rig.render.renderer import Renderer
from rig.studio.devices.folder import simulate_to_folder
from rig.studio.scene.layout import default_layout
from rig.studio.scene.simulate import simulate
from rig.studio.scene.subject import Subject, add_eyeballs
from rig.studio.sensor.faults import fault_from_text
from rig.studio.sensor.preset import Preset

NEUTRAL: Mapping[str, float] = MappingProxyType({})


def drawn_subject(model: HeadModel, rng: np.random.Generator, weights: Mapping[str, float] = NEUTRAL) -> Subject:
    """Draws a subject at random from the population of a head model, with all modes, and gives it an expression.
    ``weights``: weights of expressions, 0 to 1, by name."""
    return model_subject(model, rng.standard_normal(len(model.modes)), f"drawn from {model.name}", weights)


def model_subject(
    model: HeadModel, coefficients: np.ndarray, name: str, weights: Mapping[str, float] = NEUTRAL
) -> Subject:
    """Makes a subject from a head model: its shape from ``coefficients`` (standard deviations; modes beyond them are
    0), its expression from ``weights`` (0 to 1, by name)."""
    full = model.levels["full"]
    vertices = model.posed_vertices(coefficients, weights)
    landmarks = {name: vertices[index] for name, index in model.landmarks.items()}
    return Subject(Mesh(vertices, full.faces), landmarks, full.face_region, name, closed_lids(weights))


def subject_of(text: str, model: HeadModel, rng: np.random.Generator, expression: Sequence[str] = ()) -> Subject:
    """Makes the subject that a text names: ``random``, ``mean``, or a mesh file in the head frame (mm), whose landmarks
    are read from a file beside it. ``expression``: texts such as NAME=WEIGHT.

    Raises InputError for an unknown expression or file, and for an expression of a mesh file.
    """
    weights = weights_from_text(expression, model.expressions.names)
    if text == "random":
        return drawn_subject(model, rng, weights)
    if text == "mean":
        return model_subject(model, np.zeros(0), f"mean of {model.name}", weights)
    if weights:
        raise InputError("expression", [compose("expression-of-file")])
    path = Path(text)
    marks = landmark_file(path)
    return Subject(read_mesh(path), {} if marks is None else read_landmarks(marks), name=path.name)


@dataclass(frozen=True, slots=True)
class SubjectChoice:
    """Describes the subject in the studio: the text and the expression that ``subject_of`` reads, and the gaze (azimuth
    and elevation), or None for the model's own eyes."""

    text: str
    expression: Sequence[str] = ()
    gaze_deg: tuple[float, float] | None = None

    def drawn(self, model: HeadModel, seed: int, rng: np.random.Generator) -> Subject:
        """Makes the subject with ``subject_of`` and ``turn_eyes`` and raises their errors."""
        return turn_eyes(subject_of(self.text, model, rng, self.expression), self.gaze_deg, seed)


def turn_eyes(subject: Subject, gaze_deg: tuple[float, float] | None, seed: int) -> Subject:
    """Returns a subject with eyeballs that look along ``gaze_deg`` (azimuth and elevation) and whose colour ``seed``
    determines; without a gaze it returns the subject itself. Raises InputError for a head without landmarks."""
    return subject if gaze_deg is None else add_eyeballs(subject, *gaze_deg, np.random.default_rng((seed, 1)))


def simulate_folder(
    out: Path, *, subject: str, seed: int, preset: Preset, faults: list[str], renderer: Renderer,
    expression: Sequence[str] = (), gaze_deg: tuple[float, float] | None = None,
) -> Path:  # fmt: skip
    """Simulates a capture and writes it to the folder ``out``, as ``eigenhead simulate`` does. ``gaze_deg``: azimuth
    and elevation of eyeballs, which replace painted eyes. Returns the folder of the true head."""
    rng = np.random.default_rng(seed)
    chosen = SubjectChoice(subject, expression, gaze_deg).drawn(load_model(), seed, rng)
    planted = tuple(fault_from_text(text) for text in faults)
    taken = simulate(chosen, default_layout(), preset, rng, renderer=renderer, faults=planted)
    return simulate_to_folder(out, taken, seed=seed)
