"""A smile that was photographed is told, and the same head without it is left alone."""

from dataclasses import replace

import numpy as np
import pytest

from pipeline.contour_fit.expression_evidence import doubtful_weights
from pipeline.evidence.expression import Found
from pipeline.head_model.model import HeadModel, load_model, with_expressions, with_modes
from pipeline.reconstruct import reconstruct
from pipeline.settings import OutputSettings, Settings
from pipeline.stages.context import ReconstructionContext
from rig.render.renderer import Renderer
from rig.studio.scene.layout import default_layout
from rig.studio.scene.simulate import simulate
from rig.studio.sensor.preset import PRESET
from server.tasks.subjects import model_subject

WEIGHTS = {"mouthSmileLeft": 0.7, "mouthSmileRight": 0.6, "jawOpen": 0.15}


def found_in(model: HeadModel, weights: dict[str, float], renderer: Renderer) -> tuple[Found, ...]:
    """What level photo says of a head of the population that makes that face."""
    coefficients = np.random.default_rng(31).standard_normal(len(model.modes))
    subject = model_subject(model, coefficients, "planted", weights)
    rng = np.random.default_rng(32)
    shot = simulate(subject, default_layout(), PRESET, rng, renderer=renderer)
    settings = replace(Settings(), detail="photo", outputs=OutputSettings(surface="head"))
    return reconstruct(ReconstructionContext(shot.capture, shot.rig, model, settings, renderer)).evidence.expression


@pytest.mark.parametrize(
    ("weights", "doubtful"),
    [
        ({"mouthPucker": 0.6, "mouth-retraction": 0.7, "mouthSmileLeft": 0.5}, {"mouthPucker", "mouth-retraction"}),
        ({"mouthPucker": 0.6, "mouth-retraction": 0.2}, set()),
        ({}, set()),
        ({"jawOpen": 1.0, "eyeBlinkLeft": 1.0, "eyeWideLeft": 0.5}, {"jawOpen"}),  # lids are placed by other evidence
        ({"mouthSmileLeft": 0.9, "mouthSmileRight": 0.9, "browInnerUp": 0.6}, set()),
    ],
)
def test_opposites_and_weights_at_their_limit_are_doubtful(weights: dict[str, float], doubtful: set[str]) -> None:
    model = with_expressions(with_modes(load_model(), 2))
    names = model.expressions.names
    coefficients = np.array([3.0, -3.0, *(weights.get(name, 0.0) for name in names)])
    assert {names[row] for row in doubtful_weights(model, coefficients)} == doubtful


@pytest.mark.slow
def test_a_smile_is_named_its_weights_are_told_and_a_neutral_face_makes_none(renderer: Renderer) -> None:
    found = {each.name: each for each in found_in(load_model(), WEIGHTS, renderer)}
    for name, weight in WEIGHTS.items():
        assert found[name].weight == pytest.approx(weight, abs=0.15), name  # three of its deviations
    spurious = [each for name, each in found.items() if name not in WEIGHTS and each.weight > 0.25]
    assert spurious == []
    assert [each for each in found_in(load_model(), {}, renderer) if each.weight > 0.1] == []
