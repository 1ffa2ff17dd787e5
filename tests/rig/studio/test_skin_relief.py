"""The relief that the simulated studio gives to skin."""

import numpy as np

from rig.mesh import Mesh
from rig.studio.scene.anatomy import grid_faces
from rig.studio.scene.skin_texture import EDGE_MM, FADE, SkinRelief, relieved
from tests.support.drawn_relief import draw_relief

RADIUS_MM, SLOPE = 4.0, 0.15


def relief() -> SkinRelief:
    return draw_relief(np.random.default_rng(3), np.zeros((1, 3)), RADIUS_MM, SLOPE)


def sheet(side: int = 9, reach_mm: float = 8.0) -> Mesh:
    x, y = np.meshgrid(*[np.linspace(-reach_mm, reach_mm, side)] * 2, indexing="ij")
    vertices = np.stack([x.ravel(), y.ravel(), np.zeros(side * side)], axis=1)
    return Mesh(vertices, grid_faces(side, side, closed=False))


def test_slopes_are_the_gradient_of_the_heights() -> None:
    places = np.random.default_rng(4).uniform(-1.0, 1.0, (50, 3))
    step = 1e-5
    found = [
        (relief().heights_mm(places + step * axis) - relief().heights_mm(places - step * axis)) / (2 * step)
        for axis in np.eye(3)
    ]
    np.testing.assert_allclose(relief().slopes(places), np.stack(found, axis=1), atol=1e-6)


def test_the_slope_on_a_surface_is_the_one_asked_for() -> None:
    places = np.zeros((4000, 3))
    places[:, :2] = np.random.default_rng(5).uniform(-0.5 * FADE * RADIUS_MM, 0.5 * FADE * RADIUS_MM, (4000, 2))
    on_surface = relief().slopes(places)[:, :2]
    assert abs(np.sqrt((on_surface**2).sum(axis=1).mean()) / SLOPE - 1.0) < 0.25


def test_skin_is_divided_moved_within_the_radius_alone_and_shaded_as_it_rises() -> None:
    head = sheet()
    found = relieved(head, relief(), {"paint": head.vertices[:, :1] + 10.0})
    off = np.linalg.norm(found.places, axis=1)
    np.testing.assert_allclose(found.vertices[off > RADIUS_MM], found.places[off > RADIUS_MM], atol=1e-12)
    np.testing.assert_allclose(found.vertices[:, 2], relief().heights_mm(found.places), atol=1e-12)
    np.testing.assert_allclose(found.values["paint"][:, 0], found.places[:, 0] + 10.0, atol=1e-12)
    near = found.faces[(off[found.faces] < 0.5 * RADIUS_MM).all(axis=1)]
    edges = np.linalg.norm(found.places[near[:, 0]] - found.places[near[:, 1]], axis=1)
    assert np.median(edges) <= EDGE_MM
    first, second = (found.places[found.faces[:, k]] - found.places[found.faces[:, 0]] for k in (1, 2))
    area = np.cross(first, second)[:, 2]
    np.testing.assert_allclose(area.sum() / 2, 16.0**2)  # nothing is lost, nothing lies twice
    tilted = -found.normals[:, :2] / found.normals[:, 2:]
    np.testing.assert_allclose(tilted, relief().slopes(found.places)[:, :2], atol=1e-9)
