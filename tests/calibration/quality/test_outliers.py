"""Views and shots that the rig contradicts: each is named with its reason, and good ones stay. The rig, the board's
poses and the faults are planted; nothing is estimated here."""

from dataclasses import replace

import numpy as np
import pytest

from calibration.adjustment.intrinsics import Lens
from calibration.adjustment.state import BundleState, observe_views
from calibration.board.detection import View
from calibration.quality.outliers import (
    VIEW_LEAST_PX,
    VIEW_RATIO,
    Dropped,
    bad_views,
    drop_blurred,
    drop_misread,
    estimate_board_scale,
    explain_shot,
    miss,
    square_side_px,
    view_rms,
)
from rig.camera import Camera, Intrinsics
from rig.geometry import RigidTransform
from rig.messages.message import compose
from tests.support.board_sessions import CHECKERBOARD, Session, planted, session, visible

SHOT, NOISE_PX = "shot04", 0.2


@pytest.fixture(scope="module")
def good() -> Session:
    return session(cameras=5, shots=10, noise_px=NOISE_PX, seed=11)


@pytest.fixture(scope="module")
def state(good: Session) -> BundleState:
    return planted(good)


def of_shot(source: Session, shot: str = SHOT) -> list[View]:
    return [view for view in source.detections.views if view.shot == shot]


def with_corners(view: View, corners: np.ndarray) -> View:
    return replace(view, found=replace(view.found, corners=corners))


def explained(source: Session, state: BundleState, views: list[View], bad: list[View]) -> list[Dropped]:
    names = list(source.rig.names)
    return explain_shot(SHOT, views, bad, source.detections, state, names=names, boards=source.poses, noise_px=NOISE_PX)


def test_a_view_is_blurred_by_squares_and_by_pixels(good: Session) -> None:
    """Edges wider than a fifth of a square and than 4 px; of far boards 4 px decide, of near ones the fifth."""
    view = good.detections.views[0]
    side = square_side_px(view, CHECKERBOARD)
    limit = max(4.0, 0.2 * side)
    for rise_px, dropped in ((limit - 0.01, 0), (limit + 0.01, 1), (np.inf, 1)):
        changed = replace(view, found=replace(view.found, rise_px=rise_px))
        kept, gone = drop_blurred(replace(good.detections, views=(changed, *good.detections.views[1:])))
        assert [(drop.shot, drop.camera) for drop in gone] == [(view.shot, view.camera)] * dropped
        assert len(kept.views) == len(good.detections.views) - dropped
    assert gone[0].reason.code == "view-blurred-beyond"


def test_the_side_of_a_square_is_that_between_neighbours(good: Session) -> None:
    """Of a fronto-parallel board it is focal length by distance times the square, whatever corners are missing."""
    lens = Intrinsics(1024, 768, 1500.0, 1500.0, 511.5, 383.5)
    pose = RigidTransform(np.eye(3), np.array([-90.0, -60.0, 750.0]))
    ids = np.array([0, 1, 2, 8, 9, 17, 25])  # 8 corners a row: 2 and 9 are no neighbours, 1 and 9 are
    corners = Camera("", lens, RigidTransform.identity()).project(pose.apply(CHECKERBOARD.corners()[ids]))
    found = replace(good.detections.views[0].found, ids=ids, corners=corners)
    view = replace(good.detections.views[0], found=found)
    assert square_side_px(view, CHECKERBOARD) == pytest.approx(1500.0 * 25.0 / 750.0)
    lonely = replace(view, found=replace(found, ids=ids[[0, 2]], corners=corners[[0, 2]]))
    assert square_side_px(lonely, CHECKERBOARD) == 0.0


def test_a_view_that_its_own_lens_does_not_explain_is_left_out(good: Session) -> None:
    shots = {name: {v.shot for v in good.detections.views if v.camera == name} for name in good.rig.names}
    lenses = {
        camera.name: Lens(
            camera.name,
            camera.intrinsics,
            np.eye(9),
            NOISE_PX,
            NOISE_PX,
            len(shots[camera.name]),
            0,
            {shot: camera.camera_from_world @ good.poses[shot] for shot in shots[camera.name]},
        )
        for camera in good.rig
    }
    assert drop_misread(good.detections, lenses)[1] == []
    view = good.detections.views[3]
    bent = with_corners(view, view.found.corners + np.array([0.0, 8.0]) * (view.found.ids[:, None] % 2))
    views = (*good.detections.views[:3], bent, *good.detections.views[4:])
    kept, gone = drop_misread(replace(good.detections, views=views), lenses)
    assert [(drop.shot, drop.camera, drop.reason.code) for drop in gone] == [
        (view.shot, view.camera, "corners-off-board")
    ]
    assert len(kept.views) == len(views) - 1


def test_bad_views_are_those_far_beyond_the_median(good: Session, state: BundleState) -> None:
    views, names, shots = list(good.detections.views), list(good.rig.names), list(good.poses)
    rms = view_rms(state, observe_views(views, names, shots, CHECKERBOARD))
    for view, found_px in zip(views, rms, strict=True):
        corners = good.poses[view.shot].apply(CHECKERBOARD.corners()[view.found.ids])
        off = good.rig[view.camera].project(corners) - view.found.corners
        assert found_px == pytest.approx(np.sqrt((off**2).sum(axis=1).mean()), abs=1e-9)
    limit = max(VIEW_RATIO * float(np.median(rms)), VIEW_LEAST_PX)
    for shift, bad in ((0.8 * limit, False), (1.2 * limit, True)):
        views[5] = with_corners(good.detections.views[5], good.detections.views[5].found.corners + [shift, 0.0])
        found = bad_views(state, observe_views(views, names, shots, CHECKERBOARD))
        assert found[5] == bad
        assert found.sum() == bad


def test_a_miss_takes_the_best_turn_of_the_board_and_is_endless_behind_the_camera(good: Session) -> None:
    """A board with two even sides of squares looks the same after half a turn."""
    board = replace(CHECKERBOARD, columns=8, rows=6)
    camera, pose = good.rig[SHOT_CAMERA], good.poses[SHOT]
    ids, pixels = visible(camera, pose, board)
    view = replace(of_shot(good)[0], found=replace(of_shot(good)[0].found, ids=ids, corners=pixels[::-1]))
    assert len(board.turns()) == 2
    assert miss(view, camera, pose, board) < 1e-6
    assert miss(view, camera, pose, replace(board, columns=9)) > 5.0
    behind = RigidTransform(pose.rotation, 3.0 * camera.centre_world)
    assert miss(view, camera, behind, board) > 100.0


SHOT_CAMERA = "cam02"


@pytest.mark.parametrize("square_mm", [22.0, 27.5])
def test_a_board_of_other_squares_is_measured(good: Session, state: BundleState, square_mm: float) -> None:
    other = replace(CHECKERBOARD, square_mm=square_mm)
    views = [with_corners(v, visible(good.rig[v.camera], good.poses[SHOT], other)[1]) for v in of_shot(good)]
    cameras = {camera.name: camera for camera in good.rig}
    scale = estimate_board_scale(views, cameras, CHECKERBOARD, good.poses[SHOT])
    assert scale is not None
    np.testing.assert_allclose(scale, (square_mm / 25.0, 0.0), atol=1e-6)
    (drop,) = explained(good, state, views, views[:1])
    assert (drop.camera, drop.reason.code) == (None, "squares-of-other-board")
    assert f"{square_mm:.1f} mm" in drop.reason.text
    assert estimate_board_scale(views[:1], cameras, CHECKERBOARD, good.poses[SHOT]) is None, "one camera tells no size"


def test_a_picture_under_another_name_says_whose_it_is(good: Session, state: BundleState) -> None:
    views = of_shot(good)
    first, second = views[0], views[1]
    exchanged = replace(first, found=second.found)
    (drop,) = explained(good, state, [exchanged, *views[1:]], [exchanged])
    assert drop.reason == compose("picture-of-camera", camera=second.camera)
    assert str(drop).startswith(f"{SHOT}")


def test_a_picture_of_another_moment_says_of_which(good: Session, state: BundleState) -> None:
    for view in of_shot(good):
        ids, pixels = visible(good.rig[view.camera], good.poses["shot05"], CHECKERBOARD)
        if len(ids):
            late = with_corners(view, pixels)
            (drop,) = explained(good, state, [late, *(v for v in of_shot(good) if v is not view)], [late])
            assert drop.reason == compose("picture-of-shot", shot="shot05")
            return
    pytest.fail("no camera of the shot sees the board in the next one")


def test_a_view_that_nothing_explains_contradicts_and_most_of_a_shot_moved(good: Session, state: BundleState) -> None:
    views = of_shot(good)
    odd = with_corners(views[0], views[0].found.corners + [40.0, -25.0])
    (drop,) = explained(good, state, [odd, *views[1:]], [odd])
    assert (drop.camera, drop.reason.code) == (odd.camera, "view-contradicts")
    rng = np.random.default_rng(4)
    views = [with_corners(v, v.found.corners + rng.normal(scale=30.0, size=2)) for v in of_shot(good)]
    (drop,) = explained(good, state, views, views)
    assert (drop.camera, drop.reason.code) == (None, "board-moved-between")
