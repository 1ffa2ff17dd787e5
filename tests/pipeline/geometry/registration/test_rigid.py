"""Steps on distances along normals: their derivatives, a planted motion, and a prior."""

import numpy as np
import pytest

from pipeline.geometry.registration.rigid import (
    Counterparts,
    fit_motion,
    motion_about,
    motion_columns,
    solve_with_prior,
)
from rig.geometry import Similarity, rotation_from_vector

RNG = np.random.default_rng(0)
POINTS = RNG.uniform(-80.0, 80.0, (200, 3))
NORMALS = RNG.standard_normal((200, 3))
NORMALS /= np.linalg.norm(NORMALS, axis=1, keepdims=True)


def test_columns_are_the_derivatives_of_the_motion() -> None:
    columns, step = motion_columns(POINTS - 5.0, NORMALS, scale=True), 1e-6
    for k, along in enumerate(step * np.eye(7)):
        moved = motion_about(np.full(3, 5.0), along).apply(POINTS) - motion_about(np.full(3, 5.0), -along).apply(POINTS)
        # Central differences err by step^2 of the third derivative, 80 mm: below rounding, 80 * 1e-16 / 1e-6.
        np.testing.assert_allclose((moved * NORMALS).sum(axis=1) / (2.0 * step), columns[:, k], atol=1e-7)


@pytest.mark.parametrize("scale", [1.0, 1.03])
def test_a_planted_motion_is_found(scale: float) -> None:
    truth = Similarity(scale, rotation_from_vector(np.array([0.2, -0.1, 0.3])), np.array([4.0, -6.0, 9.0]))
    there, across, reaches = truth.apply(POINTS), NORMALS @ truth.rotation.T, list[float]()

    def meet(_: Similarity, points: np.ndarray, reach_mm: float) -> Counterparts:
        reaches.append(reach_mm)
        return Counterparts(across, ((there - points) * across).sum(axis=1), np.ones(200), max(0.5 * reach_mm, 1.0))

    found = fit_motion(POINTS, meet, Similarity.identity(), reach_mm=4.0, steps=20, still_mm=1e-9, scale=scale != 1.0)
    assert found is not None
    np.testing.assert_allclose(found.apply(POINTS), there, atol=1e-9)
    assert reaches[:4] == [4.0, 2.0, 1.0, 1.0]
    assert fit_motion(POINTS, lambda *_: None, found, reach_mm=1.0, steps=3, still_mm=1e-6) is None


def test_a_prior_is_a_measurement_of_zero() -> None:
    columns, ahead, information = RNG.standard_normal((30, 4)), RNG.standard_normal(30), RNG.uniform(0.5, 2.0, 30)
    prior, state = np.array([3.0, 0.5, 0.0, 0.0]), np.array([0.4, -1.0, 2.0, 3.0])
    rows = np.concatenate([columns * np.sqrt(information)[:, None], np.diag(np.sqrt(prior))])
    right = np.concatenate([ahead * np.sqrt(information), -np.sqrt(prior) * state])
    expected = np.linalg.lstsq(rows, right, rcond=None)[0]
    np.testing.assert_allclose(solve_with_prior(columns, ahead, information, prior, state), expected, atol=1e-12)
