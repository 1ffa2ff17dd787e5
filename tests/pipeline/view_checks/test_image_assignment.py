"""Exchanges of files planted in a capture of the studio: cables, pictures alone, plates alone, duplicates."""

from dataclasses import replace
from typing import Literal

import cv2
import numpy as np
import pytest

from pipeline.imaging.silhouette import silhouette_from_mask
from pipeline.view_checks.image_assignment import (
    ExchangedPictures,
    WrongRig,
    assign_images,
    duplicate_views,
    misplaced_plates,
)
from rig.capture import Capture, reassign_images
from tests.support.layouts import arrangement

pytestmark = [pytest.mark.gl, pytest.mark.slow]  # the studio takes ten seconds for one capture
EXCHANGE = {"cam04": "cam06", "cam06": "cam04"}


def judged(shot, capture, exchanged: Literal["repair", "refuse"] = "repair", rig=None):
    """``assign_images`` with the studio's true masks, filed as the pictures are: nothing here depends on their
    noise."""
    truth = {id(shot.capture.images[name]): mask for name, mask in shot.masks.items()}

    def segmented(filed: Capture):
        return {name: silhouette_from_mask(truth[id(image)]) for name, image in filed.images.items()}

    return assign_images(capture, rig or shot.rig, segmented, exchanged=exchanged)


def of_masks(filed: Capture):
    return {name: silhouette_from_mask(mask) for name, mask in filed.masks.items()}


def filed_right(shot, found):
    return all(
        found.capture.images[name] is shot.capture.images[name]
        and found.capture.backgrounds[name] is shot.capture.backgrounds[name]
        and np.array_equal(found.silhouettes[name].mask, shot.masks[name])
        for name in shot.rig.names
    )


def test_a_good_capture_is_left_as_it_is_and_plates_of_one_backdrop_are_nobodys(half_size_shot):
    found = judged(half_size_shot, half_size_shot.capture)
    assert (found.pictures, found.plates, found.warnings) == ({}, {}, ())
    assert filed_right(half_size_shot, found)
    shot, capture = half_size_shot, half_size_shot.capture
    same = Capture(capture.images, {name: capture.backgrounds["cam00"] for name in shot.rig.names})
    assert misplaced_plates(same, shot.rig) == {}


@pytest.mark.parametrize(
    ("planted", "code"),
    [
        ({"pictures": EXCHANGE, "plates": EXCHANGE, "points": EXCHANGE}, "cameras-exchanged"),
        ({"pictures": EXCHANGE, "plates": EXCHANGE}, "cameras-exchanged"),
        ({"pictures": EXCHANGE}, "cameras-exchanged"),
        ({"plates": EXCHANGE}, "plates-exchanged"),
    ],
    ids=["cables", "cables, points picked before", "pictures alone", "plates alone"],
)
def test_an_exchange_is_named_and_filed_back(half_size_shot, planted, code):
    found = judged(half_size_shot, reassign_images(half_size_shot.capture, **planted))
    assert filed_right(half_size_shot, found)
    for landmark, views in half_size_shot.capture.features.items():
        assert found.capture.features[landmark].keys() == views.keys()
    assert [warning.code for warning in found.warnings] == [code]
    assert "cam04 and cam06 hold each other's" in found.warnings[0].text


def test_masks_alone_that_are_exchanged_are_filed_back_and_photographs_stay(half_size_shot):
    shot = half_size_shot
    masked = Capture(shot.capture.images, masks=shot.masks)

    found = assign_images(reassign_images(masked, masks=EXCHANGE), shot.rig, of_masks, exchanged="repair")
    assert [warning.code for warning in found.warnings] == ["masks-exchanged"]
    assert "cam04 and cam06 hold each other's masks" in found.warnings[0].text
    assert found.pictures == {}
    assert all(found.capture.images[name] is shot.capture.images[name] for name in shot.rig.names)
    assert all(np.array_equal(found.silhouettes[name].mask, shot.masks[name]) for name in shot.rig.names)


def test_masks_whose_rows_were_counted_from_the_bottom_are_turned_back(half_size_shot):
    shot = half_size_shot
    masks = {name: np.ascontiguousarray(mask[::-1]) for name, mask in shot.masks.items()}
    soft = {name: mask.view(np.uint8) * np.uint8(255) for name, mask in masks.items()}
    capture = Capture(shot.capture.images, masks=masks, soft_masks=soft)
    found = assign_images(capture, shot.rig, of_masks, exchanged="repair")
    assert [warning.code for warning in found.warnings] == ["masks-turned"]
    for masks in (found.capture.masks, found.capture.soft_masks):
        assert all(np.array_equal(masks[name] > 0, mask) for name, mask in shot.masks.items())


def test_an_exchange_is_refused_where_the_settings_say_so_and_pictures_of_another_rig_always(half_size_shot):
    with pytest.raises(ExchangedPictures, match="cam04 and cam06 hold each other's pictures"):
        judged(half_size_shot, reassign_images(half_size_shot.capture, pictures=EXCHANGE, plates=EXCHANGE), "refuse")
    with pytest.raises(ExchangedPictures, match="clean plates"):
        judged(half_size_shot, reassign_images(half_size_shot.capture, plates=EXCHANGE), "refuse")

    with pytest.raises(WrongRig, match=r"cameras\.json is of another rig"):
        judged(half_size_shot, half_size_shot.capture, rig=arrangement("a").scaled(0.5))


def test_a_duplicated_picture_is_left_to_its_own_camera(half_size_shot):
    copied = reassign_images(half_size_shot.capture, pictures={"cam08": "cam07"}, plates={"cam08": "cam07"})
    found = judged(half_size_shot, copied)
    (warning,) = found.warnings
    assert warning.code == "picture-duplicated"
    assert warning.text.startswith("cam08 holds the same picture as cam07")
    assert [name for name, s in found.silhouettes.items() if not s.quality.usable] == ["cam08"]


def test_a_picture_that_was_encoded_anew_is_a_duplicate(half_size_shot):
    shot, encoded = half_size_shot, cv2.imencode(".jpg", half_size_shot.capture.images["cam07"])[1]
    images = {**shot.capture.images, "cam08": cv2.imdecode(encoded, cv2.IMREAD_COLOR)}
    masks = {**shot.masks, "cam08": shot.masks["cam07"]}
    silhouettes = {name: silhouette_from_mask(mask) for name, mask in masks.items()}
    assert duplicate_views(replace(shot.capture, images=images), silhouettes, shot.rig) == {"cam08": "cam07"}
