"""Skin of a surface and of a head that lie apart by planted distances."""

import numpy as np
import pytest

from pipeline.fusion.refinement import MAX_MM, Measured, SeenVertices, deviation_mm, neighbours, remove_islands
from pipeline.fusion.skin import REACH_MM, HeadSkin, combine_with_head, skin_share
from rig.mesh import Mesh
from tests.support.scenes import ellipsoid

DEPTH_MM, STATED_MM = 0.15, 0.3  # what depth of good photographs states, and a head


def stating(head: Mesh, deviation_mm: float = STATED_MM) -> HeadSkin:
    return HeadSkin(head, np.full(len(head.vertices), deviation_mm))


def lifted(head: Mesh, height_mm: float | np.ndarray) -> Mesh:
    return Mesh(head.vertices + np.reshape(height_mm, (-1, 1)) * head.normals(), head.faces)


def combined(
    head: Mesh,
    height_mm: float | np.ndarray,
    *,
    skin: np.ndarray | float = 1.0,
    depth_mm: np.ndarray | float = DEPTH_MM,
    stated_mm: float = STATED_MM,
    hairy: bool = False,
) -> np.ndarray:
    """Returns the heights (mm) over the head of a surface at the given heights, after both are combined."""
    count = len(head.vertices)
    surface = lifted(head, height_mm)
    depth_mm = depth_mm * np.ones(count)
    seen = SeenVertices.of(surface.vertices, depth_mm > 0.0)
    mesh = combine_with_head(
        surface, skin * np.ones(count), stating(head, stated_mm), depth_mm, seen, hairy * np.ones(count, bool)
    )
    return ((mesh.vertices - head.vertices) * head.normals()).sum(axis=1)


def noise(head: Mesh, deviation_mm: float) -> np.ndarray:
    return np.random.default_rng(4).normal(0.0, deviation_mm, len(head.vertices))


@pytest.mark.parametrize("height_mm", [0.1, -0.1])
def test_skin_that_both_show_goes_between_them(height_mm: float) -> None:
    left = np.median(combined(ellipsoid(5), height_mm)) / height_mm
    assert 0.0 < left < 0.8


def test_the_noisier_the_surface_the_more_the_head_counts() -> None:
    head = ellipsoid(5)
    left = [np.median(combined(head, 0.1, depth_mm=deviation_mm)) for deviation_mm in (0.1, 0.3, 1.0)]
    assert left[0] > left[1] > left[2] > 0.0


def test_the_larger_the_deviation_that_the_head_states_the_less_it_counts() -> None:
    head = ellipsoid(5)
    left = [np.std(combined(head, noise(head, 0.2), stated_mm=stated_mm)) for stated_mm in (0.2, 1.0, 8.0)]
    assert left[0] < left[1] < left[2]
    assert left[0] < 0.3 * 0.2
    assert left[2] > 0.8 * 0.2


@pytest.mark.parametrize("height_mm", [-2.5, 2.5])
def test_a_crater_and_a_speck_go_to_the_head(height_mm: float) -> None:
    """A vertex and its neighbours, however sure they are of themselves."""
    head = ellipsoid(5)
    spot = np.linalg.norm(head.vertices - head.vertices[0], axis=1) < 4.0
    assert 4 < spot.sum() < 10
    assert np.abs(combined(head, 0.1 + height_mm * spot)).max() < 0.5


def test_a_pit_of_chance_matches_goes_to_the_head() -> None:
    head = ellipsoid(6)
    pit = np.linalg.norm(head.vertices - head.vertices[0], axis=1) < 5.0
    assert combined(head, -6.0 * pit, depth_mm=0.3, stated_mm=1.0).min() > -1.0


def test_no_hair_grows_below_the_skin() -> None:
    head = ellipsoid(5)
    left = [np.median(np.abs(combined(head, height, skin=0.6, depth_mm=2.0))) for height in (-1.5, 1.5)]
    assert left[0] < 0.7 * left[1]


def test_under_hair_an_unsure_head_counts_less() -> None:
    head = ellipsoid(5)
    bare, hairy = (
        np.std(combined(head, noise(head, 2.0), depth_mm=1.5, stated_mm=2.0, hairy=h)) for h in (False, True)
    )
    assert bare < 0.8 * hairy


@pytest.mark.parametrize("height_mm", [3.0, 8.0])
def test_a_neighbourhood_that_depth_shows_elsewhere_stays(height_mm: float) -> None:
    """Hair that was labelled as skin, or a mouth that the head lacks: 6 cm wide."""
    head = ellipsoid(5)
    far = np.linalg.norm(head.vertices - head.vertices[0], axis=1)
    left = combined(head, height_mm * (far < 30.0))
    assert np.median(left[far < 15.0]) == pytest.approx(height_mm, rel=0.07)
    assert np.abs(left[far > 45.0]).max() < 0.3


def test_a_head_of_the_wrong_shape_leaves_what_the_surface_shows() -> None:
    """Dents and bumps of 4 cm that the head lacks, ten times what it states of itself."""
    head = ellipsoid(5)
    waves = 3.0 * np.sin(head.vertices[:, 1] / 13.0)
    left = combined(head, waves)
    assert np.corrcoef(left, waves)[0, 1] > 0.98
    assert np.std(left - waves) < 0.25 * np.std(waves)


def test_what_lies_beyond_reach_stays() -> None:
    head = ellipsoid(5)
    height = REACH_MM + 1.0
    assert np.abs(combined(head, height) - height).max() < 1e-9


def test_hair_stays_and_fades_into_skin() -> None:
    head = ellipsoid(5)
    skin = np.clip(head.vertices[:, 0] / 20.0, 0.0, 1.0)
    height = 0.3 + noise(head, 0.2)
    moved = np.abs(combined(head, height, skin=skin) - height)
    assert moved[skin == 0.0].max() < 1e-9
    assert moved[(skin > 0.3) & (skin < 0.7)].mean() < moved[skin == 1.0].mean()


def test_a_place_that_no_view_sees_follows_the_head_from_its_rim() -> None:
    """A pit 3 cm wide within seen skin that stands 0.3 mm over the head."""
    head = ellipsoid(5)
    far = np.linalg.norm(head.vertices - head.vertices[0], axis=1)
    silent = far < 15.0
    height = np.where(silent, -1.5, 0.3)
    left = combined(head, height, skin=1.0 - silent, depth_mm=np.where(silent, 0.0, DEPTH_MM))
    assert np.abs(left[silent]).max() < 0.35
    rim = (far > 11.0) & silent
    assert np.abs(np.median(left[rim]) - np.median(left[(far > 15.0) & (far < 19.0)])) < 0.15


def test_a_place_that_no_view_sees_is_what_is_seen_next_to_it() -> None:
    head = ellipsoid(5)
    seen, right = head.vertices[:, 2] > 0.0, head.vertices[:, 0] > 0.0
    beside = neighbours(head.faces, len(seen))
    share = skin_share(beside, (seen & right).astype(float), SeenVertices.of(head.vertices, seen))
    middle = np.abs(head.vertices[:, 0]) < 20.0
    assert share[~seen & right & ~middle].min() > 0.9
    assert share[~seen & ~right & ~middle].max() < 0.1


def test_without_depth_nothing_moves() -> None:
    head = ellipsoid(3)
    surface = lifted(head, 0.3)
    none = np.zeros(len(head.vertices))
    seen = SeenVertices.of(surface.vertices, none > 0.0)
    assert combine_with_head(surface, none, stating(head), none, seen, none > 0.0) is surface


HEAD = ellipsoid(4)  # edges of 8 mm: triangles of 30 mm2


def seen_where(mesh: Mesh, seen: np.ndarray) -> Measured:
    count = len(mesh.vertices)
    return Measured(np.zeros(count), np.where(seen, 25.0, 0.0), np.zeros(count), np.where(seen, 2, 0).astype(np.uint8))


def test_a_small_patch_with_nothing_seen_about_it_is_not_seen() -> None:
    front, behind = HEAD.vertices[:, 2] > 10.0, np.argmin(HEAD.vertices[:, 2])
    alone = np.zeros(len(front), bool)
    alone[HEAD.faces[(HEAD.faces == behind).any(axis=1)][:2]] = True  # two triangles
    kept = remove_islands(HEAD, seen_where(HEAD, front | alone))
    np.testing.assert_array_equal(kept.views > 0, front)


def test_a_larger_patch_stays() -> None:
    back = HEAD.vertices[:, 2] < -85.0
    kept = remove_islands(HEAD, seen_where(HEAD, back))
    np.testing.assert_array_equal(kept.views > 0, back)


def test_what_is_taken_off_has_the_deviation_of_a_guess() -> None:
    alone = np.zeros(len(HEAD.vertices), bool)
    alone[HEAD.faces[0]] = True
    before = seen_where(HEAD, alone)
    after = remove_islands(HEAD, before)
    found = [deviation_mm(SeenVertices.of(HEAD.vertices, one.views > 0), one) for one in (before, after)]
    assert found[0][HEAD.faces[0]].max() < 1.0
    assert (found[1] == MAX_MM).all()
