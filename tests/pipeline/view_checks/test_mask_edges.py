"""Masks that do not follow their photographs, planted: too large, too small, under each other's names."""

import cv2
import numpy as np
import pytest

from pipeline.imaging.silhouette import Silhouette, silhouette_from_mask
from pipeline.view_checks.mask_edges import find_edge, find_turned_masks, masks_alone_exchanged, masks_off_edges

NAMES = ("cam00", "cam01", "cam02")


def subject(k: int) -> np.ndarray:
    """An egg on shoulders, of another shape for every camera."""
    mask = np.zeros((240, 320), np.uint8)
    cv2.ellipse(mask, (110 + 50 * k, 110), (40 + 6 * k, 60 - 5 * k), 20 * k, 0, 360, 1, -1)
    cv2.rectangle(mask, (90 + 40 * k, 150), (150 + 40 * k, 239), 1, -1)
    return mask


def photograph(k: int) -> np.ndarray:
    """A subject with texture and noise before a wall with some."""
    rng = np.random.default_rng(k)
    cloth = cv2.GaussianBlur(rng.uniform(60, 120, (240, 320, 3)).astype(np.float32), (0, 0), 4)
    wall = cv2.GaussianBlur(rng.uniform(120, 200, (240, 320, 3)).astype(np.float32), (0, 0), 8)
    share = cv2.GaussianBlur(subject(k).astype(np.float32), (0, 0), 1.0)[..., None]
    return np.clip(share * cloth + (1 - share) * wall + rng.normal(0, 2, wall.shape), 0, 255).astype(np.uint8)


def grown(mask: np.ndarray, px: int) -> Silhouette:
    disc = cv2.getStructuringElement(cv2.MORPH_ELLIPSE, (2 * abs(px) + 1, 2 * abs(px) + 1))
    changed = mask if px == 0 else cv2.dilate(mask, disc) if px > 0 else cv2.erode(mask, disc)
    return silhouette_from_mask(changed.view(bool))


IMAGES = {name: photograph(k) for k, name in enumerate(NAMES)}


@pytest.mark.parametrize("px", [0, 5, -5])
def test_the_edge_of_the_photograph_is_found_beside_the_outline(px: int) -> None:
    edge = find_edge(IMAGES["cam01"], grown(subject(1), px))
    assert edge is not None
    assert edge.offset_px == pytest.approx(-px, abs=1.0)
    assert edge.is_off == (px != 0)


@pytest.mark.parametrize(("px", "where"), [(5, "outside"), (-5, "inside")])
def test_masks_that_are_all_too_large_or_too_small_are_warned_of_once(px: int, where: str) -> None:
    masks = {name: grown(subject(k), px) for k, name in enumerate(NAMES)}
    (warning,) = masks_off_edges(IMAGES, masks, NAMES)
    assert warning.code == "masks-off-edges"
    assert warning.text.startswith(f"3 of 3 masks lie about 5 px {where} the edges in the photographs")


def test_tight_masks_one_that_is_loose_and_pictures_without_edges_warn_of_none() -> None:
    masks = {name: grown(subject(k), 6 if k == 0 else 0) for k, name in enumerate(NAMES)}
    assert masks_off_edges(IMAGES, masks, NAMES) == []
    assert masks_off_edges(IMAGES, masks, ()) == []
    grey = {name: np.full((240, 320, 3), 128, np.uint8) for name in NAMES}
    masks = {name: grown(subject(k), 0) for k, name in enumerate(NAMES)}
    assert masks_off_edges(grey, masks, NAMES) == []
    assert not masks_alone_exchanged(grey, masks, {"cam00": "cam01", "cam01": "cam00"})


def test_masks_under_other_names_are_told_from_pictures_and_masks_together() -> None:
    owners = {"cam00": "cam01", "cam01": "cam02", "cam02": "cam00"}  # of each camera the name its own is filed under
    masks = {filed: grown(subject(NAMES.index(name)), 0) for name, filed in owners.items()}
    assert masks_alone_exchanged(IMAGES, masks, owners)
    together = {filed: IMAGES[name] for name, filed in owners.items()}
    assert not masks_alone_exchanged(together, masks, owners)


@pytest.mark.parametrize(
    ("rows", "columns", "turn"), [(-1, 1, "flip-down"), (1, -1, "flip-across"), (-1, -1, "turned-half"), (1, 1, None)]
)
def test_masks_that_are_turned_against_the_photographs_are_named(rows: int, columns: int, turn: str | None) -> None:
    masks = {name: grown(np.ascontiguousarray(subject(k)[::rows, ::columns]), 0) for k, name in enumerate(NAMES)}
    found = find_turned_masks(IMAGES, masks, NAMES)
    assert {name: said.code for name, said in found.items()} == (dict.fromkeys(NAMES, turn) if turn else {})
    one = {**{name: grown(subject(k), 0) for k, name in enumerate(NAMES)}, "cam01": masks["cam01"]}
    assert [*find_turned_masks(IMAGES, one, NAMES)] == (["cam01"] if turn else [])
    assert find_turned_masks(IMAGES, masks, ()) == {}
