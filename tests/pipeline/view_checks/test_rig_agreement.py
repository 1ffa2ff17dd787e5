"""Rigs that did not take the pictures, planted: each is named with its remedy, and the rig that did is left alone."""

from dataclasses import replace

import cv2
import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from pipeline.head_model.model import load_model
from pipeline.imaging.silhouette import ViewQuality, silhouette_from_mask
from pipeline.multiview.tangency import outer_hull
from pipeline.view_checks.camera_assignment import INSET_PX, mean_misfit, tangency_errors_px
from pipeline.view_checks.rig_agreement import are_loose, explain_disagreement, find_lens_reading, misplaced_camera
from rig.geometry import RigidTransform, rotation_from_vector
from rig.plausibility import rig_faults
from rig.studio.scene.layout import HEIGHT, WIDTH, default_layout
from tests.support.changed_rigs import relensed, reposed
from tests.support.layouts import ARRANGEMENTS_DEG, arrangement
from tests.support.subjects import off_by

pytestmark = pytest.mark.gl


@pytest.fixture(scope="module")
def seen(renderer):
    """A rig that is off by what a calibration leaves, and a bare head's true masks and silhouettes."""
    rig, model = default_layout().scaled(0.5), load_model()
    vertices = model.vertices(0.8 * np.random.default_rng(2).standard_normal(60))
    with renderer.silhouette_set(rig, model.levels["full"].faces) as drawn:
        masks = drawn.masks(vertices + (10.0, -15.0, 5.0))
    return off_by(rig, 0.06, np.random.default_rng(0)), masks, silhouettes(masks)


def silhouettes(masks):
    return {name: silhouette_from_mask(np.ascontiguousarray(mask)) for name, mask in masks.items()}


def reflected(rig, axis):
    """The rig in a left-handed world, its rotations made proper by the same axis of the cameras."""
    mirror = np.diag(np.where(np.arange(3) == axis, -1.0, 1.0))
    return reposed(rig, lambda pose: RigidTransform(mirror @ pose.rotation @ mirror, mirror @ pose.translation))


def test_the_rig_that_took_the_pictures_is_left_alone(seen):
    rig, _, of_all = seen
    rng = np.random.default_rng(5)
    assert explain_disagreement(of_all, rig) is None
    for count in range(3, 11):
        assert explain_disagreement(of_all, rig.subset(rng.choice(rig.names, count, replace=False))) is None


@pytest.mark.parametrize(
    ("quarter", "half", "loose"),
    [(22e-4, 50e-4, True), (20e-4, 60e-4, False), (20e-4, 90e-4, True), (40e-4, 50e-4, False)],
)
def test_masks_are_loose_where_half_of_the_planes_meet_closely(quarter: float, half: float, loose: bool) -> None:
    missed = np.interp(np.linspace(0, 1, 121), [0, 0.25, 0.5, 1], [0.0, quarter, half, 3 * half]).reshape(11, 11, 1)
    assert are_loose(np.append(missed, np.full((11, 11, 1), np.nan), axis=2)) is loose


@pytest.mark.parametrize(("axis", "loose_px"), [(0, 0), (1, 0), (1, 6)])
def test_a_mirrored_rig_is_named_where_some_outlines_are_loose_too(seen, axis, loose_px):
    rig, masks, _ = seen
    spread = {name: cv2.dilate(mask.astype(np.uint8), np.ones((loose_px + 1, 1))) > 0 for name, mask in masks.items()}
    loose = {name: spread[name] if k % 3 == 0 else masks[name] for k, name in enumerate(masks)}
    found = explain_disagreement(silhouettes(loose), reflected(rig, axis))
    assert found is not None
    assert found.code == "rig-mirrored"
    assert "write it right-handed" in found.text


def test_quaternions_with_the_real_part_last_are_named_though_the_views_that_they_spoil_are_left_out(seen):
    _, _, of_all = seen

    def pose(of):
        x, y, z, w = Rotation.from_matrix(of.rotation).as_quat()
        return RigidTransform(Rotation.from_quat([y, z, w, x]).as_matrix(), of.translation)

    contradicted = ViewQuality(usable=False, figures={"strange_share": 0.04})
    spoilt = {name: replace(s, quality=contradicted) if k % 2 else s for k, (name, s) in enumerate(of_all.items())}
    found = explain_disagreement(spoilt, reposed(default_layout().scaled(0.5), pose))
    assert found is not None
    assert "quaternions whose real part came last" in found.text


def test_rotations_that_are_transposed_are_named_where_the_cameras_look_at_the_origin(seen):
    """Such a rig looks at one point in either reading: only the outlines can tell."""
    _, _, of_all = seen
    rig = default_layout().scaled(0.5)
    written = reposed(rig, lambda pose: RigidTransform(pose.rotation.T, pose.translation))
    assert rig_faults(written) == []
    found = explain_disagreement(of_all, written)
    assert found is not None
    assert "contains the rotation transposed" in found.text
    assert "transpose each rotation" in found.text


def test_one_camera_far_from_its_place_is_named_and_no_good_one(seen):
    rig, _, of_all = seen
    rng = np.random.default_rng(8)
    assert misplaced_camera(of_all, rig) is None
    for count in range(5, 11):
        assert misplaced_camera(of_all, rig.subset(rng.choice(rig.names, count, replace=False))) is None
    for name in ("cam01", "cam04", "cam09"):
        for degrees in (15.0, 180.0):  # a shift of its picture tells turns of a few degrees
            turn = RigidTransform(rotation_from_vector(np.radians([0.0, 0.0, degrees])), np.zeros(3))
            assert misplaced_camera(of_all, reposed(rig, lambda pose, turn=turn: turn @ pose, name)) == name


@pytest.mark.parametrize(
    ("change", "word"),
    [(lambda m: m[:, ::-1], "left to right"), (lambda m: m[::-1], "upside down"), (lambda m: m[::-1, ::-1], "by 180")],
)
def test_pictures_that_are_all_turned_alike_are_named(seen, change, word):
    rig, masks, _ = seen
    assert word in str(explain_disagreement(silhouettes({name: change(mask) for name, mask in masks.items()}), rig))


@pytest.mark.parametrize(("quarters", "word"), [(1, "90 degrees anticlockwise"), (3, "90 degrees clockwise")])
def test_square_pictures_turned_by_90_degrees_are_named(seen, quarters, word):
    """Others are refused when they are read: their sides are exchanged."""
    rig, masks, _ = seen
    beside, height = (WIDTH - HEIGHT) // 4, HEIGHT // 2
    square = relensed(rig, lambda k: replace(k, width=height, cx=k.cx - beside))
    cropped = {name: mask[:, beside:-beside] for name, mask in masks.items()}
    assert explain_disagreement(silhouettes(cropped), square) is None
    turned = {name: np.rot90(mask, quarters) for name, mask in cropped.items()}  # anticlockwise
    assert word in str(explain_disagreement(silhouettes(turned), square))


@pytest.mark.parametrize(("quarters", "word"), [(1, "90 degrees anticlockwise"), (3, "90 degrees clockwise")])
def test_turned_pictures_whose_cameras_had_width_and_height_exchanged_are_named(seen, quarters, word):
    """The sizes agree then, and so do the principal points; the poses do not."""
    rig, masks, _ = seen
    written = relensed(rig, lambda k: replace(k, width=k.height, height=k.width, cx=k.cy, cy=k.cx))
    turned = {name: np.rot90(mask, quarters) for name, mask in masks.items()}  # anticlockwise
    assert word in str(explain_disagreement(silhouettes(turned), written))


@pytest.mark.slow
def test_the_calibration_of_another_rig_is_named(seen):
    _, _, of_all = seen
    for name in ARRANGEMENTS_DEG:
        found = explain_disagreement(of_all, arrangement(name).scaled(0.5))
        assert found is not None
        assert "is of another rig" in found.text
        assert "calibrate it again" in found.text


@pytest.mark.slow
def test_principal_points_of_the_whole_picture_are_named_where_it_was_cropped(seen):
    rig, _, of_all = seen
    found = explain_disagreement(of_all, relensed(rig, lambda k: replace(k, cx=k.cx + 60, cy=k.cy + 40)))
    assert found is not None
    changes = found.parameters["changes"]
    assert isinstance(changes, tuple)
    moved = next(change for change in changes if change.code == "principal-points-moved")
    assert (moved.parameters["right_px"], moved.parameters["down_px"]) == pytest.approx((-60, -40), abs=12)


def test_principal_points_counted_from_below_are_named(seen):
    _, _, of_all = seen
    rows = np.random.default_rng(3).normal(0.0, 14.0, 11)  # px, off the middle

    def rig_of(sign):
        middles = iter(HEIGHT / 4 - 0.5 + sign * rows)
        return relensed(default_layout().scaled(0.5), lambda k: replace(k, cy=next(middles)))

    moved = {}
    for camera in rig_of(1.0):
        was = default_layout().scaled(0.5)[camera.name].intrinsics.cy
        shift = np.array([[1.0, 0.0, 0.0], [0.0, 1.0, camera.intrinsics.cy - was]])
        mask = of_all[camera.name].mask.astype(np.uint8)
        moved[camera.name] = cv2.warpAffine(mask, shift, mask.shape[::-1], borderMode=cv2.BORDER_REPLICATE) > 0
    found = explain_disagreement(silhouettes(moved), rig_of(-1.0))
    assert found is not None
    assert found.code == "principal-points-from-below"


@pytest.mark.slow  # the studio takes ten seconds for one capture
@pytest.mark.parametrize("zoom", [1.5, 0.6])
def test_focal_lengths_of_another_zoom_are_found(half_size_shot, zoom):
    shot = half_size_shot
    hulls = [outer_hull(silhouette_from_mask(shot.masks[name]), INSET_PX) for name in shot.rig.names]
    zoomed = relensed(shot.rig, lambda k: replace(k, fx=zoom * k.fx, fy=zoom * k.fy))
    found = find_lens_reading(hulls, zoomed, lambda rig: float(np.median(mean_misfit(tangency_errors_px(hulls, rig)))))
    assert found.factor == pytest.approx(1 / zoom, rel=0.06)
    assert max(map(abs, found.shift)) < 0.02
    assert found.is_other
    assert "focal lengths (fx, fy) are multiplied" in found.message().text
