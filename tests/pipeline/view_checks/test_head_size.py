"""The head's diameter from outlines: heads, children and hair pass; a rig in another unit is refused by name."""

from dataclasses import replace

import cv2
import numpy as np
import pytest

from calibration.scene.scale import times
from pipeline.head_model.model import load_model
from pipeline.imaging.silhouette import silhouette_from_mask
from pipeline.view_checks.guards import FaceEvidence, Guards
from pipeline.view_checks.head_size import (
    SKULL_MM,
    WrongScale,
    crown_disc,
    find_low_crowns,
    head_diameter_mm,
    judge_head_size,
)
from rig.rig import Rig
from rig.studio.scene.hair import HairStyle
from rig.studio.scene.layout import default_layout
from tests.support.subjects import random_subjects, worn_silhouettes

pytestmark = pytest.mark.gl
STYLES = {
    "short": HairStyle(12.0),
    "over ears": HairStyle(20.0, over_ears=True),
    "long": HairStyle(13.0, over_ears=True, hanging_mm=150.0),
    "thick": HairStyle(40.0, over_ears=True),
}


@pytest.fixture(scope="module")
def heads(renderer):
    model, rig, rng = load_model(), default_layout().scaled(0.25), np.random.default_rng(3)
    subjects = random_subjects(len(STYLES), seed=3)
    return rig, {
        name: worn_silhouettes(model, subject, rig, renderer, style, rng)
        for subject, (name, style) in zip(subjects, STYLES.items(), strict=True)
    }


@pytest.mark.parametrize("name", STYLES)
@pytest.mark.parametrize("scale", [0.85, 1.0])
def test_people_pass(heads, name, scale):
    rig, of = heads
    assert judge_head_size(of[name], times(rig, scale)) == []
    few = rig.subset(rig.names[:4])
    assert judge_head_size({camera: of[name][camera] for camera in few.names}, times(few, scale)) == []


@pytest.mark.parametrize("factor", [0.25, 0.45, 2.2, 3.3, 5.0])  # hair 40 mm thick at half its size is a child's head
@pytest.mark.parametrize("name", STYLES)
def test_another_unit_is_refused(heads, name, factor):
    rig, of = heads
    with pytest.raises(WrongScale) as refused:
        judge_head_size(of[name], times(rig, factor))
    ratio = float(str(refused.value).split("about ")[1].split(" times")[0])
    assert 0.75 * factor < ratio < 1.35 * factor
    assert "scale.json" in str(refused.value)


def test_what_is_between_is_warned_of(heads):
    rig, of = heads
    (warning,) = judge_head_size(of["over ears"], times(rig, 1.5))
    assert warning.code == "scale-implausible"
    assert "times as large as a head" in warning.text


@pytest.mark.parametrize("turns", [0, 1, 2, 3])
def test_a_camera_may_hang_on_its_side(heads, turns):
    _, of = heads
    mask = of["short"]["cam00"].mask
    upright, turned = crown_disc(mask, 0), crown_disc(np.ascontiguousarray(np.rot90(mask, turns)), -turns % 4)
    assert upright is not None
    assert turned is not None
    assert turned[1] == pytest.approx(upright[1], abs=2.0)


def cropped(rig, silhouettes):
    """The pictures cut at the left so that a shoulder leaves through the side, and masks that end below the chin, above
    the border: as other programs cut the chest off by a plane."""
    cameras, masks = [], {}
    for camera in rig:
        mask = silhouettes[camera.name].mask
        rows, columns = np.flatnonzero(mask.any(axis=1)), np.flatnonzero(mask.any(axis=0))
        left = int(columns[0] + (columns[-1] - columns[0]) // 12)
        end = rows[0] + 9 * (rows[-1] - rows[0]) // 10
        k = camera.intrinsics
        masks[camera.name] = silhouette_from_mask(
            np.ascontiguousarray(np.where(np.arange(k.height)[:, None] < end, mask, False)[:, left:])
        )
        cameras.append(replace(camera, intrinsics=replace(k, width=k.width - left, cx=k.cx - left)))
    return Rig(tuple(cameras)), masks


@pytest.mark.parametrize("factor", [0.5, 1.0])
@pytest.mark.parametrize("name", STYLES)
def test_a_mask_may_end_anywhere(heads, renderer, name, factor):
    rig, of = heads
    rig, of = rig.scaled(factor), {camera: halved(s, factor) for camera, s in of[name].items()}
    cut_rig, cut = cropped(rig, of)
    assert sum(bool(s.mask[:, 0].any()) and not s.mask[-1].any() for s in cut.values()) >= 7
    whole = head_diameter_mm(of, rig)
    assert head_diameter_mm(cut, cut_rig) == pytest.approx(whole, rel=0.1)
    assert judge_head_size(cut, cut_rig) == []


def halved(silhouette, factor):
    height, width = silhouette.mask.shape
    size = int(width * factor), int(height * factor)
    small = cv2.resize(silhouette.mask.view(np.uint8), size, interpolation=cv2.INTER_NEAREST)
    return silhouette_from_mask(small.view(bool))


@pytest.mark.parametrize("count", [4, 11])
def test_one_wrong_mask_moves_no_crossing(heads, count):
    rig, of = heads
    few = rig.subset(rig.names[:count])
    whole = {name: of["short"][name] for name in few.names}
    broken = few.names[1]
    mask = whole[broken].mask.copy()
    rows = np.flatnonzero(mask.any(axis=1))
    mask[: rows[0] + (rows[-1] - rows[0]) * 2 // 3] = False  # the shoulders alone
    cut = {**whole, broken: silhouette_from_mask(mask)}
    assert head_diameter_mm(cut, few) == pytest.approx(head_diameter_mm(whole, few), rel=0.05)


def test_a_face_of_a_humans_size_or_anyway_overrules_the_outlines(heads):
    rig, of = heads
    scaled = times(rig, 3.3)
    front = scaled[scaled.front_camera()]
    turn = front.camera_from_world.rotation.T * (1.0, -1.0, -1.0)  # a camera looks along z, with y down
    face = FaceEvidence(3.3 * head_middle(of["short"], rig), turn, rig.names[:3], ())
    (warning,) = judge_head_size(of["short"], scaled, lambda: face)
    assert warning.code == "scale-implausible"
    assert "scale.json" not in warning.text
    (warning,) = judge_head_size(of["short"], scaled, guards=Guards(anyway=True))
    assert warning.code == "pose-doubtful"
    assert "times as large as a head" in warning.text


@pytest.mark.parametrize("hair", STYLES)
@pytest.mark.parametrize("count", [3, 11])
def test_a_mask_that_lacks_the_crown_is_named(heads, hair, count):
    rig, of = heads
    some = rig.subset(rig.names[:count])
    turn = rig[rig.front_camera()].camera_from_world.rotation.T * (1.0, -1.0, -1.0)
    face = FaceEvidence(head_middle(of[hair], rig) - turn @ SKULL_MM, turn, rig.names[:3], ())
    whole = {name: of[hair][name] for name in some.names}
    assert find_low_crowns(whole, some, lambda: face) == {}
    mask = whole[some.names[0]].mask.copy()
    mask[: np.flatnonzero(mask.any(axis=1))[0] + 24] = False  # 50 mm
    cut = whole | {some.names[0]: silhouette_from_mask(mask)}
    assert find_low_crowns(cut, some, lambda: face).keys() == {some.names[0]}
    assert find_low_crowns(cut, some, lambda: None) == {}


def head_middle(silhouettes, rig):
    """Where the discs of the heads meet, by plain least squares over views that are all right."""
    rays, centres = [], []
    for camera in rig:
        disc = crown_disc(silhouettes[camera.name].mask, 0)
        assert disc is not None
        rays.append(camera.rays_world(disc[0][None])[0])
        centres.append(camera.centre_world)
    across = np.eye(3) - np.einsum("ni,nj->nij", rays, rays)
    return np.linalg.solve(across.sum(axis=0), np.einsum("nij,nj->i", across, np.array(centres)))


def test_a_cut_crown_says_nothing(heads):
    rig, of = heads
    cut = {}
    for name, silhouette in of["short"].items():
        rows = np.flatnonzero(silhouette.mask.any(axis=1))
        mask = np.roll(silhouette.mask, -rows[0] - 10, axis=0)
        mask[-rows[0] - 10 :] = mask[-rows[0] - 11]
        cut[name] = replace(silhouette_from_mask(mask), quality=silhouette.quality)
    assert head_diameter_mm(cut, rig) is None
    assert judge_head_size(cut, times(rig, 5.0)) == []
