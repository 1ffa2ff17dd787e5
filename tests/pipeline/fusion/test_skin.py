"""Skin of a surface and of a head that lie apart by planted distances."""

import numpy as np
import pytest

from pipeline.fusion.skin import FARTHEST, HEAD_SHARE, SAME_MM, TEXTURED_MM, HeadSkin, drawn_to_skin, measured_skin
from rig.mesh import Mesh
from tests.support.scenes import ellipsoid


def sure(mesh: Mesh) -> np.ndarray:
    """Deviations of good photographs."""
    return np.full(len(mesh.vertices), 0.1)


def stating(head: Mesh, deviation_mm: float = 0.4) -> HeadSkin:
    """The head, measured everywhere, with what it states about itself."""
    count = len(head.vertices)
    return measured_skin(head, np.full(count, deviation_mm), np.ones(count, bool))


def off_by(head: Mesh, height_mm: float) -> Mesh:
    return Mesh(head.vertices + height_mm * head.normals(), head.faces)


@pytest.mark.parametrize("height_mm", [0.1, -0.1])
def test_skin_that_both_show_goes_to_their_weighted_mean(height_mm: float) -> None:
    """The share is within 1 % of the full one at 0.1 mm, exp(-0.01)."""
    head = ellipsoid(5)
    surface = off_by(head, height_mm)
    drawn = drawn_to_skin(surface, np.ones(len(surface.vertices)), stating(head), sure(head))
    left = ((drawn.vertices - head.vertices) * head.normals()).sum(axis=1)
    assert np.median(left) == pytest.approx((1.0 - HEAD_SHARE) * height_mm, rel=0.15)


def test_a_noisy_surface_counts_by_its_variance() -> None:
    """Twice the deviation of skin with texture: a fourth of the surface's share."""
    head = ellipsoid(5)
    surface = off_by(head, 0.1)
    noisy = np.full(len(surface.vertices), 2.0 * TEXTURED_MM)
    drawn = drawn_to_skin(surface, np.ones(len(surface.vertices)), stating(head), noisy)
    left = ((drawn.vertices - head.vertices) * head.normals()).sum(axis=1)
    assert np.median(left) == pytest.approx((1.0 - HEAD_SHARE) / 4.0 * 0.1, rel=0.2)


@pytest.mark.parametrize(("stated_mm", "share"), [(0.5, 0.0), (4.0, 0.37)])
def test_a_head_counts_by_how_far_off_it_states_that_it_may_be(stated_mm: float, share: float) -> None:
    """At 0.8 mm the full share of 0.7 has fallen to 0.37, by exp(-0.64)."""
    head = ellipsoid(5)
    surface = off_by(head, 0.8)
    drawn = drawn_to_skin(surface, np.ones(len(surface.vertices)), stating(head, stated_mm), sure(head))
    moved = np.linalg.norm(drawn.vertices - surface.vertices, axis=1)
    assert np.median(moved) / 0.8 == pytest.approx(share, abs=0.05)


def test_a_head_of_the_wrong_shape_leaves_what_the_surface_shows() -> None:
    """Dents and bumps of 4 cm that the head lacks, and the roughness of its own details."""
    head = ellipsoid(5)
    surface = off_by(head, 0.0)
    rough = np.random.default_rng(5).normal(0.0, 0.2, len(head.vertices))
    wrong = Mesh(head.vertices + (np.sin(head.vertices[:, 1] / 13.0) + rough)[:, None] * head.normals(), head.faces)
    drawn = drawn_to_skin(surface, np.ones(len(rough)), stating(wrong), sure(head))
    assert np.abs(drawn.vertices - surface.vertices).max() < 0.01


def test_what_lies_farther_apart_stays() -> None:
    """Hair over the skin, or a head that is wrong there."""
    head = ellipsoid(5)
    for height_mm in (3.0, FARTHEST * SAME_MM + 1.0):
        surface = off_by(head, height_mm)
        drawn = drawn_to_skin(surface, np.ones(len(surface.vertices)), stating(head), sure(head))
        assert np.abs(drawn.vertices - surface.vertices).max() < 0.01


def test_a_crater_and_a_speck_go_to_the_head_that_their_surroundings_agree_with() -> None:
    head = ellipsoid(5)
    surface = off_by(head, 0.1)
    spots = surface.vertices.copy()
    for middle, height_mm in ((head.vertices[0], -2.5), (head.vertices[40], 2.5)):
        near = np.linalg.norm(head.vertices - middle, axis=1) < 4.0  # a vertex and its neighbours
        assert 4 < near.sum() < 10
        spots[near] += height_mm * head.normals()[near]
    drawn = drawn_to_skin(Mesh(spots, head.faces), np.ones(len(spots)), stating(head), sure(head))
    left = np.abs(((drawn.vertices - head.vertices) * head.normals()).sum(axis=1))
    assert left.max() < 0.6


def test_a_crater_as_wide_as_its_surroundings_goes_to_a_head_that_silhouettes_hold() -> None:
    """An oily tip of the nose: windows err alike all over it, so that no surroundings agree with the head."""
    head = ellipsoid(5)
    wide = np.linalg.norm(head.vertices - head.vertices[0], axis=1) < 25.0
    surface = Mesh(head.vertices - 2.5 * wide[:, None] * head.normals(), head.faces)
    count = len(head.vertices)
    middle = np.linalg.norm(head.vertices - head.vertices[0], axis=1) < 8.0
    for outlined, deepest in ((None, 2.6), (middle.astype(float), 0.3)):
        stated = measured_skin(head, np.full(count, 4.0), np.ones(count, bool), outlined)
        drawn = drawn_to_skin(surface, np.ones(count), stated, sure(head))
        left = ((head.vertices - drawn.vertices) * head.normals()).sum(axis=1)
        assert deepest - 0.3 < left[0] < deepest


def test_a_gap_that_no_view_sees_goes_to_the_head_where_seen_skin_encloses_it() -> None:
    """A pit of a few vertices; the unseen back of the head is no gap, and stays but at its rim."""
    head = ellipsoid(5)
    surface, front = off_by(head, 0.1), head.vertices[:, 2] > 0.0
    middle = head.vertices[head.vertices[:, 2].argmax()]
    pit = np.linalg.norm(head.vertices - middle, axis=1) < 4.0
    assert 4 < pit.sum() < 20
    dented = Mesh(surface.vertices - 1.5 * pit[:, None] * head.normals(), head.faces)
    seen = front & ~pit
    drawn = drawn_to_skin(dented, seen.astype(float), stating(head), np.where(seen, 0.15, 0.0))
    left = ((drawn.vertices - head.vertices) * head.normals()).sum(axis=1)
    assert np.abs(left[pit]).max() < 0.3
    behind = head.vertices[:, 2] < -10.0
    assert np.abs(drawn.vertices - dented.vertices)[behind].max() == 0.0


def test_a_crust_gives_way_to_the_head_where_the_surface_itself_is_unsure() -> None:
    """Noise of 1.4 mm (RMS) about the head: a surface that states 0.5 mm takes the head's shape; one that is sure of it
    (hair, say) is believed."""
    head = ellipsoid(5)
    rough = np.random.default_rng(4).normal(0.0, 1.4, len(head.vertices))
    surface = Mesh(head.vertices + rough[:, None] * head.normals(), head.faces)
    left = {}
    for deviation_mm in (0.5, 0.15):
        drawn = drawn_to_skin(surface, np.ones(len(rough)), stating(head), np.full(len(rough), deviation_mm))
        off = ((drawn.vertices - head.vertices) * head.normals()).sum(axis=1)
        left[deviation_mm] = float(np.sqrt(np.mean(off**2)))
    assert left[0.5] < 0.5
    assert left[0.15] > 1.0


def test_only_seen_skin_moves_and_only_to_what_was_measured_of_the_head() -> None:
    head = ellipsoid(5)
    surface, front = off_by(head, 0.3), head.vertices[:, 2] > 0.0
    left = head.vertices[:, 0] > 0.0
    measured = measured_skin(head, np.full(len(front), 1.0), front)
    assert front[np.unique(measured.mesh_world.faces)].all()
    drawn = drawn_to_skin(surface, left.astype(float), measured, sure(head))
    moved = np.linalg.norm(drawn.vertices - surface.vertices, axis=1)
    assert (moved[~left] == 0.0).all()
    assert moved[left & (head.vertices[:, 2] > 5.0)].min() > 0.1
    assert moved[head.vertices[:, 2] < -10.0].max() < 0.01


def test_a_head_that_was_not_measured_moves_nothing() -> None:
    head = ellipsoid(3)
    surface = off_by(head, 0.3)
    nothing = measured_skin(head, np.full(len(head.vertices), 0.4), np.zeros(len(head.vertices), bool))
    assert drawn_to_skin(surface, np.ones(len(head.vertices)), nothing, sure(head)) is surface
