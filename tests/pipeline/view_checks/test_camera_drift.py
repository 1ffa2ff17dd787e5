"""Moved cameras against planted ones; the subject is a head of the model with hair and a shirt, at half size."""

import numpy as np
import pytest

from pipeline.head_model.model import load_model
from pipeline.imaging.silhouette import silhouette_from_mask
from pipeline.multiview.tangency import Tangency, find_tangencies
from pipeline.view_checks.camera_drift import _judge, find_drift
from rig.geometry import RigidTransform, rotation_from_vector
from rig.rig import Rig
from rig.studio.scene.layout import default_layout
from tests.support.changed_rigs import reposed
from tests.support.silhouette_subjects import dressed_head
from tests.support.spoilt_captures import close_up, loosened


@pytest.fixture(scope="module")
def subject():
    """Vertices (world) and faces of a head with hair and a shirt."""
    vertices, faces, pose = dressed_head(load_model(), default_layout(), np.random.default_rng(2), 60)
    return pose.apply(vertices), faces


def drawn_by(rig, subject, renderer):
    vertices, faces = subject
    with renderer.silhouette_set(rig, faces) as drawn:
        masks = drawn.masks(vertices)
    return {name: silhouette_from_mask(mask) for name, mask in masks.items()}


@pytest.fixture(scope="module")
def seen(renderer, subject):
    rig = default_layout().scaled(0.5)
    return rig, drawn_by(rig, subject, renderer)


def bumped(rig: Rig, name: str, turn_deg: np.ndarray) -> Rig:
    turn = RigidTransform(rotation_from_vector(np.radians(turn_deg)), np.zeros(3))
    return reposed(rig, lambda pose: turn @ pose, name)


@pytest.mark.gl
def test_tangent_planes_of_exact_cameras_agree(seen):
    """Contours of binary masks are good to about 0.2 px; two of them, at the tip of a hull, to 0.5 px."""
    rig, silhouettes = seen
    excess = np.array([t.excess_px[0] for t in find_tangencies(silhouettes, rig)])
    assert len(excess) > 40
    assert np.median(np.abs(excess)) < 0.3
    assert find_drift(silhouettes, rig) == ()


@pytest.mark.gl
@pytest.mark.parametrize(("angle", "first"), [(0.0, 0), (75.0, 1), (200.0, 2)])
def test_a_turned_camera_is_named_with_its_shift(seen, angle, first):
    """By as many pixels as 0.2 degrees are at full size; a turn of half of that about a horizontal axis, where the
    shirt is cut off, may be a loose mask as well."""
    rig, silhouettes = seen
    across = np.array([np.cos(np.radians(angle)), np.sin(np.radians(angle)), 0.0])
    for name in rig.names[first::4]:
        (drift,) = find_drift(silhouettes, bumped(rig, name, 0.4 * across))
        assert drift.camera == name
        assert drift.turn_deg == pytest.approx(0.4, abs=0.06)  # 0.4 px of noise over few equations, at 8 px of shift
        assert drift.moved


@pytest.mark.gl
def test_two_moved_cameras_are_named_and_loose_masks_move_none(seen):
    rig, silhouettes = seen
    moved = bumped(bumped(rig, "cam03", np.array([0.3, 0.0, 0.0])), "cam08", np.array([0.1, -0.25, 0.0]))
    assert {drift.camera for drift in find_drift(silhouettes, moved)} == {"cam03", "cam08"}
    assert find_drift(loosened(silhouettes), rig) == ()


@pytest.mark.gl
@pytest.mark.parametrize("name", ["cam00", "cam04"])
def test_a_close_up_with_a_loose_mask_has_not_moved(seen, subject, renderer, name):
    """It has twice the pixels a millimetre, and most of its planes touch the crown."""
    rig, silhouettes = seen
    near = Rig(tuple(close_up(camera) if camera.name == name else camera for camera in rig))
    shown = loosened(silhouettes | drawn_by(near.subset([name]), subject, renderer))
    assert [drift for drift in find_drift(shown, near) if drift.moved] == []


# Normals and excess (px) of the planes that touched one camera's outline in a simulated photograph, whose mask lacked
# hair where one of them does: only one other plane says anything of the same direction, and it says no.
BAD_STRETCH = [
    *((-0.76, 0.65, 5.98), (-0.74, -0.68, 0.85), (-0.15, 0.99, -0.09), (-0.17, -0.99, 1.49)),
    *((-0.27, 0.96, 0.68), (-0.23, -0.97, 1.74), (0.07, 1.0, -1.6), (0.1, -1.0, 0.27)),
]
NOISE_PX = 0.54  # median of the other cameras' planes
NOWHERE = np.zeros(2)


def plane(cameras: tuple[str, str], normal: tuple[float, float], excess_px: float, ratio: float = 1.0) -> Tangency:
    """One that touches the crown, where up is out; ``ratio``: pixels of the first camera to one of the second."""
    normals, outward = (np.array(normal), NOWHERE), -1.0 if normal[1] > 0 else 1.0
    return Tangency(cameras, (NOWHERE, NOWHERE), (1.0, ratio), normals, (excess_px, -excess_px / ratio), outward)


def planes(
    equations: list[tuple[float, float, float]], noise_px: float = NOISE_PX, ratio: float = 1.0
) -> list[Tangency]:
    """Those of cam02, and some that it takes no part in."""
    involved = [plane(("cam02", f"cam{k:02}"), (x, y), excess, ratio) for k, (x, y, excess) in enumerate(equations, 3)]
    return involved + 20 * [plane(("cam00", "cam01"), (0.0, 1.0), noise_px)]


CROWN = [(x, y, 0.0) for x, y, _ in BAD_STRETCH[2:]]  # all but the two steepest


def test_a_bad_stretch_of_one_outline_is_no_moved_camera():
    camera = default_layout()["cam02"]
    assert _judge("cam02", planes(BAD_STRETCH), camera) is None
    shift = np.array([-7.2, -0.7])
    moved = [(x, y, x * shift[0] + y * shift[1]) for x, y, _ in BAD_STRETCH]
    found = _judge("cam02", planes(moved), camera)
    assert found is not None
    np.testing.assert_allclose(found.shift_px, shift, atol=1e-3)
    assert (found.moved, found.warning().code) == (True, "camera-moved")


LOOSE_PX, GOOD_PX = 2.4, 0.2


def test_a_camera_whose_planes_all_touch_the_crown_may_have_a_loose_mask():
    """Out of the crown a loose mask and a camera that looks lower are the same; on both sides they are not."""
    camera = default_layout()["cam02"]
    crown = [(x, y, LOOSE_PX if y < 0 else -LOOSE_PX) for x, y, _ in CROWN]
    found = _judge("cam02", planes(crown, GOOD_PX), camera)
    assert found is not None
    assert (found.moved, found.warning().code) == (False, "mask-loose")
    assert "the mask is loose, or the camera moved by" in found.warning().text
    far = _judge("cam02", planes([(x, y, 4.0 * excess) for x, y, excess in crown], GOOD_PX), camera)
    assert far is not None
    assert far.moved  # no mask is loose by ten pixels


def test_noise_is_of_both_pictures_in_their_own_pixels():
    """What two cameras miss each other by is noise of the coarser picture, however large it is in a close-up's."""
    camera = default_layout()["cam02"]
    crown = [(x, y, 4.0 if y < 0 else -4.0) for x, y, _ in CROWN]
    assert _judge("cam02", planes(crown, GOOD_PX), camera) is not None
    assert _judge("cam02", planes(crown, GOOD_PX, ratio=6.0), camera) is None
