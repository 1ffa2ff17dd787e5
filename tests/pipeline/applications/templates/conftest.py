"""The mean of the shipped model with its landmarks, for every test of this room."""

import numpy as np
import pytest

from pipeline.head_model.model import HeadModel


@pytest.fixture(scope="module")
def mean(model: HeadModel) -> np.ndarray:
    return model.vertices(np.zeros(0))


@pytest.fixture(scope="module")
def points(model: HeadModel, mean: np.ndarray) -> dict[str, np.ndarray]:
    """Landmarks of the mean, mm."""
    return {name: mean[row] for name, row in model.landmarks.items()}


def moves(model: HeadModel, *names: str) -> dict[str, np.ndarray]:
    """Displacements of the full mesh by shapes at weight one, mm."""
    return {name: model.levels["full"].operator @ model.expressions.moved({name: 1.0}) for name in names}
