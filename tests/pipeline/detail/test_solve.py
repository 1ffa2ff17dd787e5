"""The field's posterior against dense algebra."""

import numpy as np
import pytest

from pipeline.detail.smooth_field import smooth_field
from pipeline.detail.solve import Observed, Posterior, free_directions, normal_directions, solve_field
from rig.mesh import vertex_normals
from tests.support.subdivided_spheres import subdivided_sphere


def planted(directions: str) -> tuple[Posterior, np.ndarray, np.ndarray]:
    """A posterior on 642 nodes, and its precision and right side by dense algebra."""
    vertices, faces, nodes = subdivided_sphere()
    normals = vertex_normals(vertices, faces)
    mesh, rng = nodes.coarse, np.random.default_rng(3)
    field = smooth_field(mesh.shape @ vertices, mesh.faces, 20.0)
    amplitude = np.full(len(field.mass), 2.0)
    moves = free_directions(mesh, amplitude) if directions == "free" else normal_directions(mesh, amplitude, normals)
    corner = faces[rng.choice(len(faces), 300, replace=False)]
    blend = rng.dirichlet(np.ones(3), 300)
    normal = np.einsum("nk,nkc->nc", blend, normals[corner])
    seen = Observed(corner, blend, normal, rng.normal(0, 1, 300), rng.uniform(1, 9, 300))
    rows = np.zeros((300, 3 * len(vertices)))
    for k in range(3):
        for c in range(3):
            rows[np.arange(300), 3 * corner[:, k] + c] += blend[:, k] * normal[:, c]
    rows = rows @ moves.matrix.toarray()
    prior = np.kron(field.precision().toarray(), np.eye(moves.count))
    matrix = prior + rows.T @ (seen.information[:, None] * rows)
    return solve_field(field, moves, seen), matrix, rows.T @ (seen.information * seen.offset_mm)


@pytest.mark.parametrize("directions", ["free", "normal"])
def test_the_mean_solves_the_normal_equations(directions: str) -> None:
    posterior, matrix, right = planted(directions)
    np.testing.assert_allclose(posterior.mean, np.linalg.solve(matrix, right), atol=1e-8)


def test_draws_have_the_posterior_covariance() -> None:
    posterior, matrix, _ = planted("normal")
    draws = posterior.draws(np.random.default_rng(4), 3000)
    share = (draws**2).mean(axis=1) / np.diag(np.linalg.inv(matrix))
    # A variance from 3,000 draws is known to 2.6 %.
    assert share.mean() == pytest.approx(1.0, abs=0.02)
    assert np.abs(share - 1.0).max() < 0.13
