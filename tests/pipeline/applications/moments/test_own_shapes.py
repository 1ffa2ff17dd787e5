"""The person's own shapes against planted ones."""

import numpy as np
import pytest

from pipeline.applications.moments.own_shapes import OWN, estimate_own_shapes
from pipeline.head_model.expressions import ARKIT
from pipeline.head_model.model import HeadModel

NOISE_MM = 0.1


@pytest.fixture(scope="module")
def found(model: HeadModel):
    """Six heads of somebody whose jaw opens further than the model's, and whose chin is 1 mm longer."""
    rng, names = np.random.default_rng(2), model.expressions.names
    operator, jaw = model.levels["full"].operator, names.index("jawOpen")
    shape, neutral = operator @ model.expressions.shapes[jaw], model.vertices(np.zeros(0))
    relief = np.zeros_like(neutral)
    relief[neutral[:, 1] < neutral[model.landmarks["pogonion"], 1], 1] = -1.0
    weights = np.zeros((6, len(names)))
    weights[:, jaw] = (0.0, 0.2, 0.4, 0.6, 0.8, 1.0)
    heads = neutral + relief + 1.3 * weights[:, jaw, None, None] * shape
    heads += NOISE_MM * rng.standard_normal(heads.shape)
    person = estimate_own_shapes(model, neutral, 1.0, weights, heads, np.full(heads.shape[:2], NOISE_MM))
    return person, neutral + relief, shape


def test_what_a_take_shows_is_the_persons_own(found) -> None:
    person, neutral, shape = found
    jaw = ARKIT.index("jawOpen")
    moves = np.linalg.norm(shape, axis=1) > 5.0
    error = np.linalg.norm(person.shapes[jaw] - 1.3 * shape, axis=1)[moves].mean()
    assert error < 0.15 * 0.3 * np.linalg.norm(shape, axis=1)[moves].mean()
    assert person.shown == ("jawOpen",)
    assert np.abs(person.neutral - neutral).mean() < NOISE_MM
    assert (person.shape_deviation_mm[jaw][moves] < 0.1 * OWN * np.linalg.norm(shape, axis=1)[moves]).all()


def test_what_it_does_not_show_is_the_models(found, model: HeadModel) -> None:
    person, _, _ = found
    row, name = ARKIT.index("mouthPucker"), model.expressions.names.index("mouthPucker")
    generic = model.levels["full"].operator @ model.expressions.shapes[name]
    assert np.allclose(person.shapes[row], generic, atol=1e-4)
    assert np.allclose(person.shape_deviation_mm[row], OWN * np.linalg.norm(generic, axis=1), atol=1e-4)


def test_deviations_cover_the_errors(found) -> None:
    person, neutral, _ = found
    z = (person.neutral - neutral) / person.deviation_mm[:, None]
    assert 0.2 < np.sqrt((z**2).mean()) < 1.2
