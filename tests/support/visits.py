"""Visits of one made-up person: the mannequin at rest, or another head of its vertices, wherever it sat."""

from dataclasses import replace

import numpy as np

from pipeline.applications.clinic.visit import Visit
from pipeline.applications.verification.measured import ResultIdentity
from pipeline.evidence.measurements import Measurement
from pipeline.head_model.regions import stable_region
from rig.geometry import RigidTransform, rotation_from_vector
from rig.mesh import Mesh
from tests.support.measured_heads import LEVEL, mannequin, measured_head, model

MOVED = RigidTransform(rotation_from_vector(np.array([0.15, -0.4, 0.08])), np.array([35.0, -20.0, 60.0]))


def visit(vertices: np.ndarray | None = None, *, name: str = "shot", std_mm: float = 0.1) -> Visit:
    """A visit with the mannequin's vertices (head frame, mm), or others, sure of ``std_mm``."""
    measured = measured_head(vertices, name)
    measured = replace(measured, stated_mm=np.full(len(measured.stated_mm), std_mm))
    marks = dict.fromkeys(measured.landmarks, np.array([0.3, 0.4, 1.2]))
    breadth = {"nose_breadth": Measurement(34.0, 0.5), "face_height": Measurement(120.0, None)}
    stable = stable_region(model())[model().levels[LEVEL].rows]
    return Visit(measured, np.full(len(stable), 3, np.uint8), marks, breadth, ResultIdentity("tiny", "0" * 64), stable)


def moved(of: Visit, motion: RigidTransform = MOVED, name: str = "later") -> Visit:
    """The same visit with its world moved: another rig, another day."""
    measured = of.measured
    return replace(of, measured=replace(
        measured,
        name=name,
        mesh_world=Mesh(motion.apply(measured.mesh_world.vertices), measured.mesh_world.faces),
        landmarks={key: motion.apply(point) for key, point in measured.landmarks.items()},
        head_from_world=measured.head_from_world @ motion.inverse(),
    ))  # fmt: skip


def bumped(place: str, height_mm: float, radius_mm: float = 14.0) -> np.ndarray:
    """The mannequin's vertices with a bump along the normals about a landmark."""
    head = mannequin()
    centre = head.vertices[model().levels[LEVEL].landmarks[place]]
    away = np.linalg.norm(head.vertices - centre, axis=1)
    return head.vertices + (height_mm * np.exp(-((away / radius_mm) ** 2)))[:, None] * head.normals()
