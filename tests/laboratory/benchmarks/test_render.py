"""Times of one silhouette evaluation (the brief is 15 ms for eleven views of 5,000 triangles at 512 x 384) and of one
simulated capture: eleven images of 1024 x 768 and their clean plates."""

import numpy as np
import pytest

from pipeline.head_model.model import load_model
from rig.mesh import Mesh
from rig.render.renderer import Renderer
from rig.studio.scene.layout import default_layout
from rig.studio.scene.simulate import simulate
from rig.studio.scene.subject import Subject
from rig.studio.sensor.preset import PRESET
from tests.support import scenes

pytestmark = pytest.mark.gl


@pytest.mark.parametrize("subdivisions", [4, 6], ids=["5k", "82k"])
def test_xor_costs(benchmark, subdivisions):
    head, rig = scenes.ellipsoid(subdivisions), scenes.fan(1024, 768, tuple(range(-75, 76, 15)))
    with Renderer.create() as renderer, renderer.silhouette_set(rig, head.faces, scale=0.5) as silhouettes:
        masks = silhouettes.masks(head.vertices)
        silhouettes.set_inputs(masks, {name: np.ones(mask.shape, np.float32) for name, mask in masks.items()})
        benchmark(silhouettes.xor_costs, head.vertices + 3.0)


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
