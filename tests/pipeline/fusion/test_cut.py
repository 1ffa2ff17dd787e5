"""The bust ends smoothly where photographs or masks end, and nothing of it lies behind what cameras see."""

import numpy as np
import pytest
import trimesh

from pipeline.fusion.grid import whole_box
from pipeline.fusion.rim import rim_of
from pipeline.fusion.signed_distance import FAR_MM, find_cut
from pipeline.fusion.view_stack import ViewStack, stack_views
from pipeline.geometry.nearest import PointTree, nearest
from rig.mesh import Mesh
from tests.support.ellipsoid_depths import Ellipsoid, scene
from tests.support.scenes import fan


@pytest.fixture(scope="module")
def views() -> ViewStack:
    made = scene([Ellipsoid((0, 0, 0), (60, 60, 60))], fan(200, 150))
    return stack_views(made.maps, made.silhouettes, made.rig)


def test_nothing_lies_behind_what_cameras_see_and_the_end_is_a_plane() -> None:
    """A head of 50 mm without what is lower than -30, before cameras from +z; masks hold it and a chest."""
    made = scene([Ellipsoid((0, -40, 0), (60, 130, 60))], fan(200, 150))
    views = stack_views(made.maps, made.silhouettes, made.rig)
    sphere = trimesh.creation.icosphere(5, 50.0)
    kept = (sphere.vertices[sphere.faces][..., 1] > -30.0).all(axis=1)
    head = Mesh(np.asarray(sphere.vertices), np.asarray(sphere.faces[kept], np.int32))
    front = head.vertices[(head.vertices[:, 1] > -30.0) & (head.vertices[:, 2] > 0.0)]
    seen = np.concatenate([front, front + [0.0, -60.0, 0.0]])
    cut = find_cut(whole_box(np.full(3, -150.0), np.full(3, 300.0), 6.0), views, seen, head)
    across = np.stack([np.linspace(-30, 30, 9), np.full(9, -80.0), np.full(9, -90.0)], axis=1)
    assert np.ptp(cut.distance_mm(across)) < 0.1
    assert cut.distance_mm(across).min() > 20.0
    assert (cut.distance_mm(head.vertices[head.vertices[:, 1] > 0.0]) < 1.0).all()
    assert (cut.distance_mm(seen) < 1.0).all()
    assert cut.before_mm is not None  # nobody guesses a chest before what is seen of it
    before = cut.before_mm[nearest(PointTree.of(cut.box.places()), np.array([[0, -90.0, 90], [0, 0, 90]]))[1]]
    assert before[0] > 25.0 > before[1]


def test_bust_ends_where_all_photographs_but_one_end(views: ViewStack) -> None:
    box = whole_box(np.full(3, -400.0), np.full(3, 800.0), 12.0)
    places = np.array([[0.0, 210.0, 0.0], [0.0, 180.0, 0.0]])
    second = np.sort(views.outside(places)[0], axis=0)[1]
    assert (np.abs(second) < FAR_MM / 2).all()
    assert find_cut(box, views, np.zeros((9, 3)), None).distance_mm(places) == pytest.approx(second, abs=12.0)


def test_a_frayed_rim_that_masks_end_becomes_smooth(views: ViewStack) -> None:
    """Points of a collar end 50 to 62 mm from the head's centre; masks show a ball of 60 mm, or one of 150."""
    rng = np.random.default_rng(0)
    angle, far = rng.uniform(-np.pi, np.pi, 9000), rng.uniform(30.0, 56.0, 9000)
    far += 6.0 * np.sin(40.0 * angle) * (far > 50.0)
    collar = far[:, None] * np.stack([0.8 * np.cos(angle), np.full(9000, -0.6), 0.8 * np.sin(angle)], axis=1)
    rim = rim_of(collar, np.zeros(3), np.array([0.0, -1.0, 0.0]))
    assert rim is not None
    large = scene([Ellipsoid((0, 0, 0), (150, 150, 150))], fan(200, 150))
    assert rim.share_ended(views) > 0.9
    assert rim.share_ended(stack_views(large.maps, large.silhouettes, large.rig)) == 0.0
    around = np.linspace(-np.pi, np.pi, 400)
    ring = 50.0 * np.stack([0.8 * np.cos(around), np.full(400, -0.6), 0.8 * np.sin(around)], axis=1)
    assert np.ptp(rim.beyond_mm(ring)) < 3.0
    assert 0.05 < (rim.beyond_mm(collar) > 0.0).mean() < 0.4
