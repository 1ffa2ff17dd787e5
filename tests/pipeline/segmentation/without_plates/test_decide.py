"""Captures of another program, stripped of their plates; tests/pipeline/segmentation/test_segment_studio.py has the
studio's."""

import cv2
import numpy as np
import pytest

from pipeline.segmentation.matting import solve_matte
from pipeline.segmentation.segment import segment
from pipeline.segmentation.without_plates.decide import (
    NEAR,
    ball_above,
    decision_without_plate,
    find_standing_plane,
    guess_background,
    plate_noise,
)
from pipeline.segmentation.without_plates.mask_search import CoarseMask
from pipeline.segmentation.without_plates.viewing_volume import OtherViews
from rig.capture import Capture
from rig.formats.captures.capture_folder import read_capture
from tests.pipeline.segmentation.test_segment import true_mask
from tests.pipeline.segmentation.test_segment_studio import iou
from tests.support.shared_data import shared

pytestmark = [pytest.mark.slow, pytest.mark.timeout(900)]


@pytest.mark.parametrize("folder", ["scan-a", "draw-b"])
def test_masks_of_another_programs_captures_without_their_plates(folder: str) -> None:
    capture, rig = read_capture(shared(f"data/captures/{folder}"))
    found = segment(Capture(capture.images), rig, report=lambda *_: None)
    overlap = np.array([iou(silhouette, true_mask(name, folder)) for name, silhouette in found.items()])
    assert (overlap >= 0.99).mean() >= 0.9
    assert overlap.min() >= 0.97


RADIUS = 120.3


def photograph(texture: float) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Image 640 x 480, its plate, and the distance of each pixel from a disc's edge (negative inside)."""
    rng = np.random.default_rng(0)
    row, column = np.mgrid[:480, :640].astype(float)
    away = np.hypot(column - 318.4, row - 241.7) - RADIUS
    plate = np.stack([60 + 0.05 * column, 80 + 0.04 * row, 110 - 0.03 * column], axis=2)
    plate += texture * cv2.GaussianBlur(rng.normal(size=(480, 640)), (0, 0), 6)[:, :, None] * 20
    cover = np.clip(0.5 - away, 0, 1)[:, :, None]
    linear = cover * (np.array([190.0, 140, 120]) / 255) ** 2.2 + (1 - cover) * (np.clip(plate, 1, 255) / 255) ** 2.2
    image = 255 * linear ** (1 / 2.2) + rng.normal(0, 1.5, plate.shape)
    return np.clip(image, 0, 255).astype(np.uint8), plate, away


def coarse_of(image: np.ndarray, away: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    small = cv2.resize(image, (320, 240), interpolation=cv2.INTER_AREA).astype(np.float32)
    return small, cv2.resize(away, (320, 240), interpolation=cv2.INTER_AREA)


def test_a_smooth_background_is_guessed_where_the_border_is_and_texture_makes_the_guess_uncertain() -> None:
    guesses = {}
    for texture in (0.0, 12.0):
        image, plate, away = photograph(texture)
        small, from_edge = coarse_of(image, away)
        guesses[texture] = guess_background(image, small, from_edge > 6), plate, np.abs(away) < 4
    guess, plate, rim = guesses[0.0]
    assert np.abs(guess.plates[0][rim].astype(float) - plate[rim]).max() < 3  # 12 px of 0.05 levels, and noise
    assert np.median(guess.noise) < 3
    assert np.median(guesses[12.0][0].noise) > 3 * np.median(guess.noise)


def test_the_matting_finds_the_edge_to_a_fraction_of_a_pixel() -> None:
    """From a coarse mask that is 3 px too large."""
    image, _, away = photograph(0.0)
    small, from_edge = coarse_of(image, away)
    odds = np.where(from_edge < 3, 4.0, -4.0).astype(np.float32)
    others = OtherViews(odds, odds > 0)
    decision = decision_without_plate(image, small, CoarseMask(odds, odds > 0, others))
    assert plate_noise(decision) < 4
    matte = solve_matte(image, decision)
    inside = np.zeros(away.shape, bool)
    inside[matte.box] = matte.alpha > 0.5
    assert np.count_nonzero(inside ^ (away < 0)) < 0.3 * 2 * np.pi * RADIUS  # 0.3 px all around


def test_a_head_encloses_no_backdrop() -> None:
    """Skin of the wall's colour is a hole of the coarse mask, and was one of the outline."""
    image, _, away = photograph(0.0)
    small, from_edge = coarse_of(image, away)
    row, column = np.mgrid[:240, :320]
    hole = np.hypot(column - 170, row - 120) < 15
    odds = np.where(hole, -6.0, np.clip(-3.0 * from_edge, -10, 10)).astype(np.float32)
    nothing = np.zeros_like(odds)
    found = CoarseMask(odds, (from_edge < 0) & ~hole, OtherViews(nothing, nothing > 1))
    assert not decision_without_plate(image, small, found).mask[hole].all()
    solid = decision_without_plate(image, small, found, solid=True)
    assert solid.mask[hole].all()
    assert (solid.probability[hole] > 0.95).all()
    assert np.array_equal(solid.mask & ~hole, decision_without_plate(image, small, found).mask & ~hole)


CENTRE, BALL_RADIUS = np.array([5.0, -3.0, 8.0]), 200.0


def head(rng: np.random.Generator, count: int = 600) -> np.ndarray:
    points = rng.normal(size=(count, 3))
    return CENTRE + 70 * points / np.linalg.norm(points, axis=1, keepdims=True)


def table(rng: np.random.Generator, noise_mm: float, count: int = 200) -> np.ndarray:
    """At y = -73, what the head leaves free."""
    flat = rng.uniform(-220, 220, size=(4 * count, 2))
    flat = flat[np.hypot(*flat.T) > 80][:count]
    return CENTRE + np.column_stack([flat[:, 0], -70 + rng.normal(0, noise_mm, count), flat[:, 1]])


def test_a_table_is_found_under_a_head_and_what_stands_on_it_has_the_heads_size() -> None:
    rng = np.random.default_rng(1)
    head_and_table = np.vstack([head(rng), table(rng, 0.5)])
    points = np.vstack([head_and_table, CENTRE + rng.uniform(-2000, 2000, size=(100, 3))])
    plane = find_standing_plane(points, CENTRE, BALL_RADIUS)
    assert plane is not None
    # 200 points of 0.5 mm over 250 mm: 0.035 mm of height, 0.02 degrees; ten of each.
    assert abs(plane[:3] @ CENTRE + plane[3] - 70) < 0.35
    assert plane[1] > np.cos(np.radians(0.2))
    middle, radius = ball_above(plane, head_and_table, CENTRE, BALL_RADIUS)
    assert np.linalg.norm(middle - CENTRE) < 2 * NEAR * BALL_RADIUS + 5
    assert 70 < radius < 1.25 * 75


def test_a_person_alone_stands_on_nothing_nor_on_a_table_through_the_middle() -> None:
    rng = np.random.default_rng(3)
    assert find_standing_plane(head(rng), CENTRE, BALL_RADIUS) is None
    walls = CENTRE + rng.normal(size=(300, 3)) * 150  # a room with things in it everywhere
    assert find_standing_plane(np.vstack([head(rng), walls]), CENTRE, BALL_RADIUS) is None
    half = table(rng, 0.5) + np.array([0.0, 30.0, 0.0])  # 40 mm below the middle: a tenth of the head is under it
    assert find_standing_plane(np.vstack([head(rng), half]), CENTRE, BALL_RADIUS) is None
