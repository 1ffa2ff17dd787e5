"""The smooth field against what is known of it in closed form."""

import numpy as np
import pytest
from scipy.special import k1

from pipeline.detail.smooth_field import smooth_field
from tests.support.subdivided_spheres import RADIUS_MM, subdivided_sphere

LENGTH_MM = 20.0


def test_variance_and_correlation_are_those_of_a_matern_field_on_a_sphere() -> None:
    vertices, _, nodes = subdivided_sphere()
    places = nodes.fine.shape @ vertices  # 2,562, with edges of 10 mm
    matrix = np.linalg.inv(smooth_field(places, nodes.fine.faces, LENGTH_MM).precision().toarray())
    # In spherical harmonics: sum of (2 l + 1) / (4 pi R^2) / (tau^2 (kappa^2 + l (l + 1) / R^2)^2), tau^2 = L^2 / 4 pi;
    # 1.02 here, since R is only four lengths. Edges of half a length add a few per cent.
    degree = np.arange(2000)
    spectrum = (LENGTH_MM**-2 + degree * (degree + 1) / RADIUS_MM**2) ** -2
    expected = ((2 * degree + 1) * spectrum).sum() / (RADIUS_MM * LENGTH_MM) ** 2
    assert np.diag(matrix).mean() == pytest.approx(expected, rel=0.06)
    assert np.ptp(np.diag(matrix)) < 0.15
    arc = RADIUS_MM * np.arccos(np.clip(places @ places[0] / RADIUS_MM**2, -1.0, 1.0))
    ring = (arc > 5.0) & (arc < 60.0)
    expected = arc[ring] / LENGTH_MM * k1(arc[ring] / LENGTH_MM)
    assert np.abs(matrix[0, ring] / matrix[0, 0] - expected).max() < 0.05


def test_draws_have_the_precision_as_their_covariance() -> None:
    vertices, _, nodes = subdivided_sphere()
    field = smooth_field((nodes.coarse.shape @ vertices), nodes.coarse.faces, LENGTH_MM)
    draws = field.draw(np.random.default_rng(0), 4000)
    # A variance from 4,000 draws is known to 2.2 %, its mean over 642 nodes far better.
    share = (draws**2).mean(axis=1) / field.precision().diagonal()
    assert share.mean() == pytest.approx(1.0, abs=0.01)
    assert np.abs(share - 1.0).max() < 0.12
