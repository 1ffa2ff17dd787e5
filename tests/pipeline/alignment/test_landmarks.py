"""Procrustes: planted similarities, scipy and brute force as oracles; outliers found; too little said."""

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from scipy.linalg import orthogonal_procrustes
from scipy.optimize import minimize
from scipy.stats import chi2

from pipeline.alignment.feature_checks import feature_faults
from pipeline.alignment.landmarks import (
    TooFewFeatures,
    WrongFeatures,
    align_by_features,
    consensus,
    landmark_statistics,
)
from pipeline.geometry.registration.rigid import generalised_procrustes, procrustes
from pipeline.head_model.landmarks import NAMES, SEVEN_POINTS, mirrored
from pipeline.head_model.model import HeadModel
from rig.camera import Camera, Intrinsics
from rig.capture import Features
from rig.geometry import Similarity, look_at, rotation_from_vector, vector_from_rotation
from rig.rig import Rig

SOURCE = np.random.default_rng(1).normal(0, 50.0, (7, 3))
vectors = st.lists(st.floats(-3.0, 3.0), min_size=3, max_size=3).map(np.array)


@given(scale=st.floats(0.1, 10.0), turn=vectors, shift=vectors)
def test_a_planted_similarity_comes_back(scale: float, turn: np.ndarray, shift: np.ndarray) -> None:
    planted = Similarity(scale, rotation_from_vector(turn), 100.0 * shift)
    found = procrustes(SOURCE, planted.apply(SOURCE))
    assert found.scale == pytest.approx(scale)
    np.testing.assert_allclose(found.rotation, planted.rotation, atol=1e-9)
    np.testing.assert_allclose(found.translation, planted.translation, atol=1e-6)


def test_rotation_and_scale_agree_with_scipy() -> None:
    target = SOURCE @ rotation_from_vector(np.array([0.3, -0.2, 0.5])).T + np.random.default_rng(2).normal(
        0, 5.0, (7, 3)
    )
    source, wanted = SOURCE - SOURCE.mean(0), target - target.mean(0)
    turn, singular_sum = orthogonal_procrustes(source, wanted)  # the same rotation, transposed
    found = procrustes(SOURCE, target)
    np.testing.assert_allclose(found.rotation, turn.T, atol=1e-12)
    assert found.scale == pytest.approx(singular_sum / (source**2).sum())


def test_it_minimises_eq_3_with_weights() -> None:
    rng = np.random.default_rng(5)
    target, weights = SOURCE + rng.normal(0, 20.0, SOURCE.shape), rng.uniform(0.1, 3.0, 7)

    def eq_3(p: np.ndarray) -> float:
        moved = Similarity(np.exp(p[6]), rotation_from_vector(p[:3]), p[3:6]).apply(SOURCE)
        return float(weights @ ((target - moved) ** 2).sum(axis=1))

    found = procrustes(SOURCE, target, weights)
    ours = eq_3(np.concatenate([vector_from_rotation(found.rotation), found.translation, [np.log(found.scale)]]))
    assert ours == pytest.approx(minimize(eq_3, np.zeros(7), tol=1e-12).fun, rel=1e-7)


def test_a_mirrored_target_and_any_unit_give_a_rotation_and_points_on_a_line_are_refused() -> None:
    found = procrustes(SOURCE, SOURCE * (-1.0, 1.0, 1.0))
    assert np.linalg.det(found.rotation) == pytest.approx(1.0)
    planted = Similarity(1.0, rotation_from_vector(np.array([0.3, -0.2, 0.5])), np.zeros(3))
    for unit in (1e-6, 1e6):
        np.testing.assert_allclose(procrustes(unit * SOURCE, planted.apply(unit * SOURCE)).rotation, planted.rotation)
    line = np.outer(np.arange(5.0), [1.0, 2.0, 3.0])
    for points in (line, np.zeros((5, 3))):
        with pytest.raises(ValueError, match=r"^points on a line determine no rotation$"):
            procrustes(points, points)


def test_generalised_procrustes_with_equal_covariances_is_procrustes() -> None:
    target = 1.1 * SOURCE + np.random.default_rng(6).normal(0, 3.0, SOURCE.shape)
    plain = procrustes(SOURCE, target)
    # Without a source covariance and with a free scale the likelihood is eq. (3).
    found = generalised_procrustes(
        SOURCE, target, np.zeros((21, 21)), np.eye(21), start=Similarity.identity(), scale_spread=1e6
    )
    assert found.scale == pytest.approx(plain.scale, rel=1e-8)
    np.testing.assert_allclose(found.rotation, plain.rotation, atol=1e-8)
    np.testing.assert_allclose(found.translation, plain.translation, atol=1e-6)


def test_generalised_procrustes_beats_the_plain_one_on_heads_of_the_population(model: HeadModel) -> None:
    rng = np.random.default_rng(7)
    mean, spread = landmark_statistics(model, list(SEVEN_POINTS), 0.5)
    noise = 0.25 * np.eye(21)
    root = np.linalg.cholesky(spread)
    plain_mm, weighed_mm = [], []
    for _ in range(60):
        pose = Similarity(1.0, rotation_from_vector(rng.normal(0, 0.3, 3)), rng.normal(0, 30.0, 3))
        points = pose.apply(mean + (root @ rng.standard_normal(21)).reshape(-1, 3)) + rng.normal(0, 0.5, (7, 3))
        plain = procrustes(mean, points)
        weighed = generalised_procrustes(mean, points, spread, noise, start=plain)
        ring = 80.0 * np.array([[0.0, 1.0, 0.0], [0.0, -1.0, 0.0], [1.0, 0.0, 0.0], [-1.0, 0.0, 0.0]])
        for found, errors in ((plain, plain_mm), (weighed, weighed_mm)):
            errors.append(np.linalg.norm(found.apply(ring) - pose.apply(ring), axis=1).mean())
    assert np.mean(weighed_mm) < 0.9 * np.mean(plain_mm)


@pytest.mark.parametrize("wrong", [0, 1, 2])
def test_consensus_finds_the_gross_outliers(wrong: int) -> None:
    rng = np.random.default_rng(wrong)
    for _ in range(10):
        target = SOURCE @ rotation_from_vector(rng.normal(0, 1.0, 3)).T + rng.normal(0, 100.0, 3)
        target += rng.normal(0, 2.0, target.shape)
        bad = rng.choice(7, wrong, replace=False)
        target[bad] += 60.0 * np.sign(rng.standard_normal((wrong, 3)))
        kept = consensus(SOURCE, target, np.full(7, 2.0))
        assert kept is not None
        assert not kept[bad].any()
        # squared distance of a good point is 4 chi-square(3); 16 is passed by 1 in 1,000
        assert kept.sum() >= 7 - wrong - 1
    assert chi2.sf(16.0, 3) < 2e-3


def camera(name: str, x: float) -> Camera:
    pose = look_at(np.array([x, 0.0, 1000.0]), np.zeros(3), np.array([0.0, 1.0, 0.0]))
    return Camera(name, Intrinsics(1024, 768, 1500.0, 1500.0, 511.5, 383.5), pose)


RIG = Rig((camera("left", -400.0), camera("front", 0.0), camera("right", 400.0)))


def picked(model: HeadModel, pose: Similarity, names: tuple[str, ...], z: np.ndarray | None = None) -> Features:
    vertices = pose.apply(model.vertices(np.zeros(0) if z is None else z))
    return {n: {c.name: c.project(vertices[[model.landmarks[n]]])[0] for c in RIG} for n in names}


def test_the_mean_head_is_found_where_it_stands(model: HeadModel) -> None:
    pose = Similarity(1.0, rotation_from_vector(np.array([0.1, -0.4, 0.05])), np.array([15.0, -20.0, 30.0]))
    found = align_by_features(model, picked(model, pose, SEVEN_POINTS), RIG).world_from_head
    np.testing.assert_allclose(found.rotation, pose.rotation, atol=1e-6)
    np.testing.assert_allclose(found.translation, pose.translation, atol=1e-3)


def test_a_confused_landmark_is_named_and_does_not_turn_the_head(model: HeadModel) -> None:
    pose = Similarity(1.0, np.eye(3), np.array([5.0, 0.0, 0.0]))
    features = {**picked(model, pose, SEVEN_POINTS)}
    features["exocanthion_right"] = features["exocanthion_left"]
    found = align_by_features(model, features, RIG)
    (off,) = [remark.text for remark in found.remarks if remark.code == "feature-off"]
    assert "exocanthion_right is left out, because it lies" in off
    np.testing.assert_allclose(found.world_from_head.rotation, np.eye(3), atol=1e-6)


def test_too_few_points_and_points_on_a_line_say_what_to_do(model: HeadModel) -> None:
    two = picked(model, Similarity.identity(), SEVEN_POINTS[:2])
    with pytest.raises(TooFewFeatures, match=r"2 points are usable.*Pick more points"):
        align_by_features(model, two, RIG)
    single = {**two, "gnathion": {"front": np.array([500.0, 400.0])}, "my_point": two["exocanthion_left"]}
    with pytest.raises(TooFewFeatures, match=r"gnathion is left out.*is picked in 1 view.*my_point is no landmark"):
        align_by_features(model, single, RIG)
    midline = picked(model, Similarity.identity(), ("stomion", "labiale_superius", "labiale_inferius"))
    with pytest.raises(TooFewFeatures, match="on one line"):
        align_by_features(model, midline, RIG)


def test_sides_that_are_the_viewer_s_and_numbers_in_place_of_names_are_named(model: HeadModel) -> None:
    features = picked(model, Similarity(1.0, np.eye(3), np.array([5.0, 0.0, 0.0])), NAMES)
    exchanged = {mirrored(name): views for name, views in features.items()}
    with pytest.raises(WrongFeatures, match="once right and left are exchanged"):
        align_by_features(model, exchanged, RIG)
    numbered = {str(number): views for number, views in enumerate(features.values())}
    with pytest.raises(WrongFeatures, match=r"no point has the name of a landmark \(0, 1, 2, 3 and"):
        align_by_features(model, numbered, RIG)


def test_rows_and_columns_that_are_exchanged_are_named(model: HeadModel) -> None:
    features = picked(model, Similarity(1.0, np.eye(3), np.array([45.0, 0.0, 0.0])), SEVEN_POINTS)
    exchanged = {name: {camera: at[::-1] for camera, at in views.items()} for name, views in features.items()}
    with pytest.raises(WrongFeatures, match=r"write each as \[column, row\]"):
        align_by_features(model, exchanged, RIG)
    (fault,) = feature_faults(exchanged, RIG)
    assert "once rows and columns are exchanged" in fault.text


def test_points_of_other_pictures_are_named_and_careless_ones_are_not(model: HeadModel) -> None:
    features = picked(model, Similarity(1.0, np.eye(3), np.array([45.0, 0.0, 0.0])), NAMES)
    rng = np.random.default_rng(4)

    def scattered(px: float) -> Features:
        return {name: {c: at + rng.normal(0, px, 2) for c, at in views.items()} for name, views in features.items()}

    assert feature_faults(scattered(3.0), RIG) == []
    (fault,) = feature_faults(scattered(150.0), RIG)
    assert "were picked in other pictures than these" in fault.text
    assert "remove features.json" in fault.text
