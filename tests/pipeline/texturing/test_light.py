"""The light against integrals over the sphere, and against a light that was planted."""

import numpy as np
import pytest
import trimesh

from pipeline.texturing.light import RETURNED, fit_light, harmonics, spread_directions, transfer
from pipeline.texturing.neighbourhood import Neighbourhood, neighbours
from rig.mesh import Mesh
from rig.studio.scene.anatomy import grid_faces
from tests.support.scenes import ellipsoid

SKIN = np.array([0.45, 0.30, 0.22])


def around(mesh: Mesh) -> Neighbourhood:
    return Neighbourhood.of(*neighbours(mesh.faces, len(mesh.vertices)))


def test_the_harmonics_are_orthonormal() -> None:
    basis = harmonics(spread_directions(20_000))
    np.testing.assert_allclose(4 * np.pi * basis.T @ basis / len(basis), np.eye(9), atol=1e-3)


def test_a_convex_head_shows_the_cosines_integral_of_each_harmonic() -> None:
    mesh = ellipsoid(4)
    normals = mesh.normals()
    found = transfer(mesh, normals, around(mesh), directions=16)
    towards = spread_directions(20_000)
    rows = np.random.default_rng(1).integers(0, len(normals), 40)
    wanted = 4.0 / len(towards) * np.clip(normals[rows] @ towards.T, 0, None) @ harmonics(towards)
    np.testing.assert_allclose(found[rows], wanted, atol=2e-3)  # of the quadrature


def test_a_ball_over_the_ground_hides_its_form_factor() -> None:
    """Even light reaches the ground below a ball of radius r at height h but for (r / h)^2."""
    side = np.linspace(-100, 100, 41)
    x, y = np.meshgrid(side, side)
    ground = np.stack([x.ravel(), y.ravel(), np.zeros(x.size)], axis=1)
    faces = grid_faces(41, 41, closed=False)[:, ::-1]
    ball = trimesh.creation.icosphere(4, radius=30.0)
    mesh = Mesh(
        np.concatenate([ground, np.asarray(ball.vertices) + (0, 0, 60.0)]),
        np.concatenate([faces, np.asarray(ball.faces) + len(ground)]).astype(np.int32),
    )
    even = np.zeros(9)
    even[0] = 1 / 0.282095
    normals = np.concatenate([np.tile((0.0, 0.0, 1.0), (len(ground), 1)), np.asarray(ball.vertices) / 30.0])
    shown = (transfer(mesh, normals, around(mesh), directions=384) @ even)[: len(ground)].reshape(41, 41)
    hidden = (1 - shown) / (1 - RETURNED)
    assert hidden[20, 20] == pytest.approx(0.25, abs=0.02)  # 384 directions, edges of maps of 2 mm
    assert hidden[0, 0] < 0.05


def test_a_planted_light_is_found_from_skin_with_brows() -> None:
    rng = np.random.default_rng(3)
    normals = spread_directions(4000)
    white = harmonics(normals) * np.repeat([1.0, 2 / 3, 0.25], [1, 3, 5])
    planted = np.r_[1 / 0.282095, 0.9, -0.5, 0.7, 0.3, -0.2, 0.4, 0.1, -0.3][:, None] * np.ones(3)
    planted[1:] *= (1.0, 0.8, 0.6)  # a warm lamp in grey light
    colours = SKIN * (white @ planted) * rng.normal(1, 0.05, (4000, 1))
    brows = rng.random(4000) < 0.15
    colours[brows] *= 0.2
    found = fit_light(white, colours, np.ones(4000, bool))
    assert found is not None
    # 5 % over some thousand vertices leave less than 1 %; the prior draws by (0.12 / 1)^2 / 150 of a band's power.
    np.testing.assert_allclose(found.coefficients, planted, atol=0.06)
    assert found.residual < 0.06


@pytest.mark.parametrize(("colour", "count"), [(0.0, 500), (0.4, 20)])
def test_no_light_is_told_of_black_or_of_too_little(colour: float, count: int) -> None:
    white = harmonics(spread_directions(500))
    assert fit_light(white, np.full((500, 3), colour), np.arange(500) < count) is None
