"""Time of one simulated capture: eleven images of 1024 x 768 and their clean plates."""

import numpy as np
import pytest

from pipeline.head_model.model import load_model
from rig.mesh import Mesh
from rig.render.renderer import Renderer
from rig.studio.scene.layout import default_layout
from rig.studio.scene.simulate import simulate
from rig.studio.scene.subject import Subject
from rig.studio.sensor.preset import PRESET

pytestmark = pytest.mark.gl


def test_capture(benchmark):
    model = load_model()
    level = model.levels["full"]
    vertices = model.vertices(np.zeros(1))
    landmarks = {name: vertices[index] for name, index in model.landmarks.items()}
    subject = Subject(Mesh(vertices, level.faces), landmarks, level.face_region)
    with Renderer.create() as renderer:
        benchmark.pedantic(
            lambda: simulate(subject, default_layout(), PRESET, np.random.default_rng(1), renderer=renderer),
            rounds=3,
            warmup_rounds=1,
        )
