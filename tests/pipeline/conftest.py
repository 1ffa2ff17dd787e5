"""One photographed capture that the tests of a pipeline's first steps share."""

import numpy as np
import pytest

from pipeline.eigenheads.model import load_model
from rig.render.renderer import Renderer
from rig.studio.scene.layout import default_layout
from rig.studio.scene.simulate import SimulatedCapture, simulate
from rig.studio.sensor.preset import PRESET
from server.tasks.subjects import drawn_subject


@pytest.fixture(scope="session")
def half_size_shot(renderer: Renderer) -> SimulatedCapture:
    """A subject with hair before eleven uneven backdrops, with noise and light drift, at 512 x 384 pixels."""
    rng = np.random.default_rng(23)
    return simulate(drawn_subject(load_model(), rng), default_layout().scaled(0.5), PRESET, rng, renderer=renderer)
