"""Planted scatter is found, and where a subject sits is none of it."""

import numpy as np
import pytest

from pipeline.applications.verification.judgement import scatter
from pipeline.head_model.subdivision import vertex_areas
from rig.geometry import RigidTransform, rotation_from_vector
from tests.support.scenes import ellipsoid

HEAD = ellipsoid(3)  # 642 vertices
EVERYWHERE = np.ones(len(HEAD.vertices), bool)
AREAS = vertex_areas(HEAD.vertices, HEAD.faces)


def seated(vertices: np.ndarray, rng: np.random.Generator) -> np.ndarray:
    return RigidTransform(rotation_from_vector(rng.normal(0, 0.3, 3)), rng.normal(0, 40, 3)).apply(vertices)


def test_poses_are_no_scatter_and_one_head_has_none() -> None:
    rng = np.random.default_rng(1)
    heads = np.stack([seated(HEAD.vertices, rng) for _ in range(5)])
    found = scatter(heads, HEAD.faces, EVERYWHERE)
    assert found.position_mm.max() < 1e-6
    np.testing.assert_allclose(found.mean, heads[0], atol=1e-6)
    with pytest.raises(ValueError, match="two are needed"):
        scatter(heads[:1], HEAD.faces, EVERYWHERE)


def test_planted_scatter_is_found_and_compared_with_what_was_stated() -> None:
    rng = np.random.default_rng(2)
    stated = np.where(HEAD.vertices[:, 2] > 0, 0.1, 0.3)  # mm along the normal
    normals = HEAD.normals()
    noisy = [HEAD.vertices + normals * (stated * rng.standard_normal(len(stated)))[:, None] for _ in range(40)]
    found = scatter(np.stack([seated(head, rng) for head in noisy]), HEAD.faces, EVERYWHERE)
    front = found.figures(stated, AREAS, HEAD.vertices[:, 2] > 20)
    figures = found.figures(stated, AREAS, EVERYWHERE)
    # 39 degrees of freedom at each of some 250 vertices: the RMS is known to 1 %; the motions take 6 of 642 away.
    assert front["rms_mm"] == pytest.approx(0.1, rel=0.05)
    assert figures["normal_rms_mm"] == pytest.approx(figures["stated_mm"], rel=0.05)
    assert figures["scatter_over_stated"] == pytest.approx(1.0, rel=0.05)
    assert figures["rank_correlation"] > 0.8
    assert figures["normal_rms_mm"] <= figures["rms_mm"] <= figures["p95_mm"]


def test_a_size_that_changes_is_scatter() -> None:
    heads = np.stack([scale * HEAD.vertices for scale in (0.99, 1.01)])
    found = scatter(heads, HEAD.faces, EVERYWHERE)
    radius = np.linalg.norm(HEAD.vertices - HEAD.vertices.mean(axis=0), axis=1)
    np.testing.assert_allclose(found.position_mm, np.sqrt(2.0) * 0.01 * radius, rtol=1e-6)
