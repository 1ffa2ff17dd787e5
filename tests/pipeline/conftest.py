"""What tests of the pipeline share: the shipped head model, the networks of faces, and one photographed capture."""

from typing import TYPE_CHECKING

import numpy as np
import pytest

if TYPE_CHECKING:  # pytest may load this file before it checks what is imported (tests/conftest.py)
    from pipeline.faces.networks import FaceNetworks
    from pipeline.head_model.model import HeadModel
    from rig.render.renderer import Renderer
    from rig.studio.scene.simulate import SimulatedCapture


@pytest.fixture(scope="session")
def model() -> "HeadModel":
    """The head model that is shipped. Its arrays are read-only."""
    from pipeline.head_model.model import load_model

    return load_model()


@pytest.fixture(scope="session")
def networks() -> "FaceNetworks":
    from pipeline.faces.networks import load_networks

    return load_networks()


@pytest.fixture(scope="session")
def half_size_shot(renderer: "Renderer", model: "HeadModel") -> "SimulatedCapture":
    """A subject with hair before eleven uneven backdrops, with noise and light drift, at 512 x 384 pixels."""
    from rig.studio.scene.layout import default_layout
    from rig.studio.scene.simulate import simulate
    from rig.studio.sensor.preset import PRESET
    from server.tasks.subjects import drawn_subject

    rng = np.random.default_rng(23)
    return simulate(drawn_subject(model, rng), default_layout().scaled(0.5), PRESET, rng, renderer=renderer)
