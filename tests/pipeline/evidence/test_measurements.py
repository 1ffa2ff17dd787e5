from dataclasses import replace

import numpy as np
import pytest

from pipeline.contour_fit.fit import Fit
from pipeline.evidence.measurements import DISTANCES, landmarks, measurements
from pipeline.head_model.gaussian_process import SCALES
from pipeline.head_model.model import HeadModel
from rig.geometry import Similarity, rotation_from_vector
from rig.mesh import Mesh

COUNT = 8
SIZE = COUNT + 7  # coefficients, rotation, translation, log scale


def fit_at(parameters: np.ndarray, covariance: np.ndarray | None = None) -> Fit:
    """A fit at a deviation ``parameters`` from a pose that is no special one, in the parameters of ``Fit``."""
    shape, turn, shift, grow = parameters[:COUNT], parameters[COUNT : COUNT + 3], parameters[-4:-1], parameters[-1]
    rotation = rotation_from_vector(turn) @ rotation_from_vector(np.array([0.2, -0.5, 0.1]))
    place = Similarity(1.05 * np.exp(grow), rotation, np.array([30.0, -60.0, 900.0]) + shift)
    start = np.linspace(-1, 1, COUNT)
    return Fit("contour", start + shape, place, 1, "test", covariance)


def covariance(seed: int = 0) -> np.ndarray:
    root = np.random.default_rng(seed).normal(size=(SIZE, SIZE)) / np.sqrt(SIZE)
    scale = np.r_[np.full(COUNT, 0.2), np.full(3, 0.003), np.full(3, 0.5), 0.004]
    return (root @ root.T) * np.outer(scale, scale)


def test_landmarks_are_the_models_vertices_in_the_world(model: HeadModel) -> None:
    fit = fit_at(np.zeros(SIZE))
    world = fit.world_from_head.apply(model.vertices(fit.coefficients))
    found = landmarks(model, fit)
    assert len(found) == 26
    for name, landmark in found.items():
        np.testing.assert_allclose(landmark.position_mm, world[model.landmarks[name]], atol=1e-3)
        assert landmark.std_mm is None


def test_standard_deviations_are_those_of_drawn_parameters(model: HeadModel) -> None:
    # Monte Carlo: with 4,000 draws a standard deviation is known to 1 / sqrt(8,000) = 1.1 %; four times that.
    spread = covariance()
    draws = np.random.default_rng(1).multivariate_normal(np.zeros(SIZE), spread, 4000)
    rows = np.array([model.landmarks[name] for name in ("pronasale", "zygion_left", "zygion_right")])
    basis = model.basis("full", COUNT, rows).astype(float)
    mean = model.levels["full"].operator[rows] @ model.mean.astype(float)
    points = np.empty((len(draws), 3, 3))
    for i, draw in enumerate(draws):
        fit = fit_at(draw)
        points[i] = fit.world_from_head.apply(mean + np.einsum("m,mni->ni", fit.coefficients, basis))
    fit = fit_at(np.zeros(SIZE), spread)
    tip = landmarks(model, fit)["pronasale"].std_mm
    assert tip is not None
    np.testing.assert_allclose(tip, points[:, 0].std(axis=0), rtol=0.045)
    breadth = np.linalg.norm(points[:, 1] - points[:, 2], axis=1)
    found = measurements(model, fit)["bizygomatic_breadth"]
    assert found.std_mm == pytest.approx(breadth.std(), rel=0.045)
    assert found.value_mm == pytest.approx(breadth.mean(), rel=0.002)


def test_a_rigid_motion_moves_landmarks_but_no_measurement_as_an_uncertain_scale_does(model: HeadModel) -> None:
    rigid = covariance()
    rigid[:COUNT] = rigid[:, :COUNT] = rigid[-1] = rigid[:, -1] = 0.0
    fit = fit_at(np.zeros(SIZE), rigid)
    assert all(m.std_mm is not None and m.std_mm < 1e-6 for m in measurements(model, fit).values())
    assert all(p.std_mm is not None and p.std_mm.min() > 0.01 for p in landmarks(model, fit).values())
    scale_only = np.zeros((SIZE, SIZE))
    scale_only[-1, -1] = 0.01**2
    for measurement in measurements(model, fit_at(np.zeros(SIZE), scale_only)).values():
        assert measurement.std_mm == pytest.approx(0.01 * measurement.value_mm, rel=1e-6)


# Farkas (1994) and the anthropometric survey of Gordon et al. (ANSUR, 1989), adults: mean plus or minus five standard
# deviations, wide because a landmark of a model is a vertex.
ADULT_MM = {
    "head_breadth": (125, 180),
    "head_length": (160, 225),
    "bizygomatic_breadth": (110, 165),
    "nose_length": (38, 65),
    "nose_breadth": (25, 50),
    "face_height": (95, 145),
    "mouth_breadth": (38, 68),
    "intercanthal_breadth": (24, 43),
}


def test_the_mean_head_has_an_adults_measures(model: HeadModel) -> None:
    fit = Fit("contour", np.zeros(COUNT), Similarity.identity(), 1, "test")
    found = measurements(model, fit)
    assert set(found) == set(DISTANCES)
    for name, (low, high) in ADULT_MM.items():
        assert low < found[name].value_mm < high, (name, found[name].value_mm)


def test_landmarks_slide_in_their_tangent_planes(model: HeadModel) -> None:
    """Against draws of a smooth field along the surface, with the kernel's correlation."""
    sliding = 2.0
    fit = replace(fit_at(np.zeros(SIZE), 1e-12 * np.eye(SIZE)), sliding_mm=sliding)
    mesh = Mesh(fit.world_from_head.apply(model.vertices(fit.coefficients)), model.levels["full"].faces)
    names = [name for pair in DISTANCES.values() for name in pair if name in model.landmarks]
    rows = np.array([model.landmarks[name] for name in names])
    points, normals = mesh.vertices[rows], mesh.normals()[rows]
    for name, at, normal in zip(names, points, normals, strict=True):
        found = landmarks(model, fit)[name]
        assert found.std_mm is not None
        assert (found.std_mm**2).sum() == pytest.approx(2.0 * sliding**2, rel=1e-4)  # nothing along the normal
        np.testing.assert_allclose(found.std_mm**2, sliding**2 * (1.0 - normal**2), rtol=1e-3, atol=1e-4)
        np.testing.assert_allclose(found.position_mm, at, atol=1e-3)
    apart = np.linalg.norm(points[:, None] - points[None], axis=2)
    weights = np.array([scale.amplitude_mm**2 for scale in SCALES])
    kernel = sum(w * np.exp(-0.5 * (apart / s.length_mm) ** 2) for w, s in zip(weights, SCALES, strict=True))
    root = np.linalg.cholesky(kernel / weights.sum() + 1e-9 * np.eye(len(points)))
    draws = sliding * np.einsum("pq,nqc->npc", root, np.random.default_rng(5).standard_normal((4000, len(points), 3)))
    draws -= (draws * normals).sum(axis=2, keepdims=True) * normals
    for name, (one, two) in DISTANCES.items():
        if one in names and two in names:
            i, j = names.index(one), names.index(two)
            unit = (points[j] - points[i]) / np.linalg.norm(points[j] - points[i])
            expected = ((draws[:, j] - draws[:, i]) @ unit).std()
            found_std = measurements(model, fit)[name].std_mm
            assert found_std == pytest.approx(expected, rel=0.045)  # 4,000 draws, as above


def test_an_unsure_scale_moves_landmarks_and_lengths_as_a_larger_head_would(model: HeadModel) -> None:
    sigma, sure = 0.06, fit_at(np.zeros(SIZE), np.zeros((SIZE, SIZE)))
    larger = fit_at(np.append(np.zeros(SIZE - 1), np.log(1.0 + sigma)))
    origin, lengths = sure.world_from_head.translation, measurements(model, larger)
    for name, length in measurements(model, sure).items():
        wide = length.widen_by_scale(sigma).std_mm
        assert wide == pytest.approx(np.hypot(lengths[name].value_mm - length.value_mm, length.std_mm or 0.0), rel=1e-3)
    marks = landmarks(model, larger)
    for name, mark in landmarks(model, sure).items():
        moved, wide = marks[name].position_mm - mark.position_mm, mark.widen_by_scale(sigma, origin)
        assert mark.std_mm is not None
        assert wide.std_mm is not None
        np.testing.assert_allclose(wide.std_mm, np.hypot(moved, mark.std_mm), atol=1e-3)
