"""Lids that the dense surface tells: planted blinks, open eyes, and photographs that misread an eye."""

import numpy as np
import pytest

from pipeline.contour_fit.fit import Fit
from pipeline.detail.blink import blink_shift, blinks_of, estimate_eyelid_closure, with_lids
from pipeline.detail.dense_points import SurfacePoints
from pipeline.detail.eyelids import EyeEvidence
from pipeline.head_model.model import HeadModel, load_model, with_expressions, with_modes
from rig.geometry import Similarity
from rig.mesh import vertex_normals


@pytest.fixture(scope="module")
def model() -> HeadModel:
    return with_expressions(with_modes(load_model(), 2))


def fit_of(model: HeadModel) -> Fit:
    return Fit("contour", np.zeros(len(model.modes)), Similarity.identity(), 1, "planted")


def head_of(model: HeadModel, fit: Fit) -> np.ndarray:
    return model.vertices(fit.coefficients)


def points_of(model: HeadModel, fit: Fit, noise_mm: float = 0.1) -> SurfacePoints:
    """Front of the head, with noise along the normals."""
    vertices = model.vertices(fit.coefficients)
    normals = vertex_normals(vertices, model.levels["full"].faces)
    seen = np.flatnonzero((normals[:, 2] > 0.2) & model.levels["full"].face_region)
    off = noise_mm * np.random.default_rng(3).standard_normal((len(seen), 1))
    part = np.ones(len(seen), np.uint8)
    return SurfacePoints(vertices[seen] + off * normals[seen], normals[seen], np.full(len(seen), 0.1), part)


def test_one_closed_eye_and_one_open_are_told_from_each_other(model: HeadModel) -> None:
    fit = fit_of(model)
    surface = points_of(model, with_lids(fit, model, {"right": 1.0}))
    open_eyes = {side: EyeEvidence(0.2, 0.3, 5) for side in ("right", "left")}
    lids, _ = estimate_eyelid_closure(fit, model, head_of(model, fit), surface, open_eyes)
    assert lids == {"right": 1.0, "left": 0.0}
    shut = head_of(model, with_lids(fit, model, lids))
    np.testing.assert_allclose(head_of(model, fit) + blink_shift(fit, model, lids), shut, atol=1e-3)


def test_an_open_eye_without_a_white_is_not_closed(model: HeadModel) -> None:
    fit = fit_of(model)
    nothing = {side: EyeEvidence(0.0, 0.01, 5) for side in ("right", "left")}
    assert estimate_eyelid_closure(fit, model, head_of(model, fit), points_of(model, fit), nothing) == (
        {"right": 0.0, "left": 0.0},
        frozenset(),
    )
    half = points_of(model, with_lids(fit, model, {"left": 0.75}))
    assert estimate_eyelid_closure(fit, model, head_of(model, fit), half, nothing)[0]["left"] == 1.0


def test_lids_that_close_another_way_than_the_model_are_bridged(model: HeadModel) -> None:
    fit = fit_of(model)
    vague = points_of(model, fit, noise_mm=3.0)  # half closed lids lie 1.1 times as far from them as open ones
    nothing = {side: EyeEvidence(0.0, 0.01, 5) for side in ("right", "left")}
    lids, unexplained = estimate_eyelid_closure(fit, model, head_of(model, fit), vague, nothing)
    assert lids == {"right": 0.0, "left": 0.0}
    assert unexplained == {"right", "left"}
    shown = {side: EyeEvidence(0.1, 0.3, 5) for side in ("right", "left")}
    assert not estimate_eyelid_closure(fit, model, head_of(model, fit), vague, shown)[1]


def test_a_model_that_does_not_blink_says_nothing_of_lids() -> None:
    model = with_modes(load_model(), 2)
    assert blinks_of(model) == {}
    fit = fit_of(model)
    assert estimate_eyelid_closure(fit, model, head_of(model, fit), points_of(model, fit), {}) == ({}, frozenset())
    assert not blink_shift(fit, model, {}).any()


def test_lids_lie_as_the_found_face_shows_them(model: HeadModel) -> None:
    fit = fit_of(model)
    # No white between them, and the points lie as if they were closed.
    surface = points_of(model, with_lids(fit, model, {"left": 1.0}))
    apart = {"left": EyeEvidence(0.0, 0.01, 5, opening=0.2)}
    lids, unexplained = estimate_eyelid_closure(fit, model, head_of(model, fit), surface, apart)
    assert (lids["left"], unexplained) == (0.5, frozenset())
    # Dark lashes, and points that say that the model's blink does not fit.
    together = {"left": EyeEvidence(0.1, 0.3, 5, opening=0.04)}
    _, unexplained = estimate_eyelid_closure(fit, model, head_of(model, fit), points_of(model, fit), together)
    assert unexplained == {"left"}
