"""Exchanged pictures among true silhouettes of dressed heads; cameras are off by what a calibration leaves."""

from itertools import combinations

import numpy as np
import pytest

from pipeline.imaging.silhouette import silhouette_from_mask
from pipeline.view_checks.camera_assignment import _miss_px, find_assignment, own_misfit, ring_messages, rings
from rig.messages.message import compose
from rig.rig import Rig
from rig.studio.scene.layout import default_layout
from tests.support.silhouette_subjects import captures_of, disturbed
from tests.support.spoilt_captures import knocked

CALIBRATION_PX = 0.3


@pytest.fixture(scope="module")
def subjects(renderer):
    rig = default_layout()
    rng = np.random.default_rng(17)
    return disturbed(rig, CALIBRATION_PX, rng), list(captures_of(renderer, rig, 2, rng))


def exchanged(silhouettes, filed):
    """The silhouettes as they are found when each camera in ``filed`` holds the picture of the one it is mapped to."""
    return {name: silhouettes[filed.get(name, name)] for name in silhouettes}


def inverse(filed):
    return {picture: holder for holder, picture in filed.items()}


@pytest.mark.gl
def test_good_captures_are_left_alone_whatever_cameras_are_missing(subjects):
    rig, captures = subjects
    rng = np.random.default_rng(1)
    for silhouettes in captures:
        assert not find_assignment(silhouettes, rig).pictures
        for count in range(3, 11):
            some = rig.subset(rng.choice(rig.names, count, replace=False))
            assert not find_assignment(silhouettes, some).pictures


@pytest.mark.gl
def test_exchanges_of_two_are_found(subjects):
    rig, captures = subjects
    for number, (one, two) in enumerate(list(combinations(rig.names, 2))[1::5]):  # the hardest of the 55 among them
        filed = {one: two, two: one}
        found = find_assignment(exchanged(captures[number % 2], filed), rig)
        assert found.pictures == filed
        assert found.overwhelming
        (said,) = ring_messages(found.pictures, compose("what-pictures"))
        assert said.text == f"{one} and {two} hold each other's pictures"


@pytest.mark.gl
@pytest.mark.parametrize(
    "ring", [("cam01", "cam05", "cam02"), ("cam03", "cam00", "cam10", "cam07"), tuple(default_layout().names)]
)
def test_rings_are_found_to_the_whole_rig_off_by_one(subjects, ring):
    rig, captures = subjects
    filed = dict(zip(ring, (*ring[1:], ring[0]), strict=True))
    found = find_assignment(exchanged(captures[0], filed), rig)
    assert found.pictures == inverse(filed)
    assert found.overwhelming
    assert [set(of) for of in rings(found.pictures)] == [set(ring)]


@pytest.mark.gl
def test_three_cameras_are_enough_to_name_an_exchange_but_not_to_repair_it(subjects):
    rig, captures = subjects
    three = rig.subset(("cam00", "cam04", "cam07"))
    found = find_assignment(exchanged(captures[1], {"cam04": "cam07", "cam07": "cam04"}), three)
    assert found.pictures == {"cam04": "cam07", "cam07": "cam04"}
    assert not found.overwhelming


@pytest.mark.gl
def test_knocked_cameras_keep_their_own_pictures(subjects):
    rig, captures = subjects
    rng = np.random.default_rng(4)
    for one, two in (("cam03", "cam04"), ("cam07", "cam08"), ("cam00", "cam01"), ("cam05", "cam06")):
        off = knocked(knocked(rig, one, 1.5, rng), two, 0.7, rng)
        assert not find_assignment(captures[1], off).pictures


@pytest.mark.gl
def test_a_picture_under_another_name_contradicts_the_others(subjects):
    rig, captures = subjects
    misfit = own_misfit(captures[0] | {"cam08": captures[0]["cam07"]}, rig)
    assert max(misfit, key=lambda name: misfit[name]) == "cam08"
    assert misfit["cam08"] > 0.5
    assert max(value for name, value in misfit.items() if name != "cam08") < 0.35


@pytest.mark.gl
def test_pictures_are_exchanged_only_among_cameras_of_one_size(subjects):
    rig, captures = subjects
    small = rig.subset(("cam04",)).scaled(0.5)["cam04"]
    mixed = Rig(tuple(small if camera.name == "cam04" else camera for camera in rig))
    half = {"cam04": silhouette_from_mask(captures[0]["cam04"].mask[::2, ::2])}
    filed = {"cam06": "cam08", "cam08": "cam06"}
    assert find_assignment(exchanged(captures[0], filed) | half, mixed).pictures == filed


def test_planes_without_a_direction_say_nothing_and_warn_of_nothing() -> None:
    """Warnings are errors in the tests: two angles by a step of 0, or one that is no number, are left out."""
    gap = np.array([1e-3, 0.0, np.nan, 2e-3])
    step = np.array([0.0, 0.0, 1e-3, 1e-3])
    np.testing.assert_array_equal(np.isfinite(_miss_px(gap, step)), [False, False, False, True])
