"""Skin of a surface and of a head that lie apart by planted distances."""

import numpy as np
import pytest

from pipeline.fusion.skin import FARTHEST, HEAD_SHARE, SAME_MM, drawn_to_skin, part_of
from rig.mesh import Mesh
from tests.support.scenes import ellipsoid


def sure(mesh: Mesh) -> np.ndarray:
    """Deviations of good photographs."""
    return np.full(len(mesh.vertices), 0.15)


def off_by(head: Mesh, height_mm: float) -> Mesh:
    return Mesh(head.vertices + height_mm * head.normals(), head.faces)


@pytest.mark.parametrize("height_mm", [0.1, -0.1])
def test_skin_that_both_show_goes_to_their_weighted_mean(height_mm: float) -> None:
    """The shares are within 1 % of the full one at 0.1 mm, exp(-0.01), and 4 % of the offset are left, exp(-0.04)."""
    head = ellipsoid(5)
    surface = off_by(head, height_mm)
    drawn = drawn_to_skin(surface, np.ones(len(surface.vertices)), head, sure(head))
    left = ((drawn.vertices - head.vertices) * head.normals()).sum(axis=1)
    assert np.median(left) == pytest.approx((1.0 - HEAD_SHARE) * height_mm, rel=0.15)


def test_a_head_of_the_wrong_shape_smooths_the_surface_and_does_not_move_it() -> None:
    head = ellipsoid(5)
    rough = np.random.default_rng(5).normal(0.0, 0.2, len(head.vertices))
    surface = Mesh(head.vertices + (0.8 + rough)[:, None] * head.normals(), head.faces)
    drawn = drawn_to_skin(surface, np.ones(len(rough)), head, sure(head))
    left = ((drawn.vertices - head.vertices) * head.normals()).sum(axis=1)
    assert left.mean() > 0.7
    assert left.std() < 0.8 * rough.std()


def test_what_lies_farther_apart_stays() -> None:
    """Hair over the skin, or a head that is wrong there."""
    head = ellipsoid(5)
    for height_mm in (3.0, FARTHEST * SAME_MM + 1.0):
        surface = off_by(head, height_mm)
        drawn = drawn_to_skin(surface, np.ones(len(surface.vertices)), head, sure(head))
        assert np.abs(drawn.vertices - surface.vertices).max() < 0.01


def test_a_crater_and_a_speck_go_to_the_head_that_their_surroundings_agree_with() -> None:
    head = ellipsoid(5)
    surface = off_by(head, 0.1)
    spots = surface.vertices.copy()
    for middle, height_mm in ((head.vertices[0], -2.5), (head.vertices[40], 2.5)):
        near = np.linalg.norm(head.vertices - middle, axis=1) < 4.0  # a vertex and its neighbours
        assert 4 < near.sum() < 10
        spots[near] += height_mm * head.normals()[near]
    drawn = drawn_to_skin(Mesh(spots, head.faces), np.ones(len(spots)), head, sure(head))
    left = np.abs(((drawn.vertices - head.vertices) * head.normals()).sum(axis=1))
    assert left.max() < 0.6


def test_a_crust_gives_way_to_the_head_where_the_surface_itself_is_unsure() -> None:
    """Noise of 1.4 mm (RMS) about the head: a surface that states 0.5 mm takes the head's shape; one that is sure of it
    (hair, say) is believed."""
    head = ellipsoid(5)
    rough = np.random.default_rng(4).normal(0.0, 1.4, len(head.vertices))
    surface = Mesh(head.vertices + rough[:, None] * head.normals(), head.faces)
    left = {}
    for deviation_mm in (0.5, 0.15):
        drawn = drawn_to_skin(surface, np.ones(len(rough)), head, np.full(len(rough), deviation_mm))
        off = ((drawn.vertices - head.vertices) * head.normals()).sum(axis=1)
        left[deviation_mm] = float(np.sqrt(np.mean(off**2)))
    assert left[0.5] < 0.5
    assert left[0.15] > 1.0


def test_only_seen_skin_moves_and_only_to_what_was_measured_of_the_head() -> None:
    head = ellipsoid(5)
    surface, front = off_by(head, 0.3), head.vertices[:, 2] > 0.0
    left = head.vertices[:, 0] > 0.0
    measured = part_of(head, front)
    assert front[np.unique(measured.faces)].all()
    drawn = drawn_to_skin(surface, left.astype(float), measured, sure(head))
    moved = np.linalg.norm(drawn.vertices - surface.vertices, axis=1)
    assert (moved[~left] == 0.0).all()
    assert moved[left & (head.vertices[:, 2] > 5.0)].min() > 0.1
    assert moved[head.vertices[:, 2] < -10.0].max() < 0.01


def test_a_head_that_was_not_measured_moves_nothing() -> None:
    head = ellipsoid(3)
    surface = off_by(head, 0.3)
    nothing = part_of(head, np.zeros(len(head.vertices), bool))
    assert drawn_to_skin(surface, np.ones(len(head.vertices)), nothing, sure(head)) is surface
