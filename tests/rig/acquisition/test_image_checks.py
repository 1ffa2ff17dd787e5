"""Measures of single pictures against planted blur, noise, light and movement."""

import itertools

import numpy as np
import pytest
from scipy.special import erf

from rig.acquisition.image_checks import blur_px, disturbed, exposure, noise_of, register
from tests.support.shared_data import shared
from tests.support.textured_studio import NAMES, FlatStudio


def step_edges(sigma_px: float, noise: float = 0.0) -> np.ndarray:
    """Bars 20 px wide whose edges are the integral of a normal distribution of ``sigma_px``."""
    x = np.arange(400)
    edges = sum((-1) ** i * erf((x - 20 * i - 9.7) / (np.sqrt(2) * sigma_px)) for i in range(20))
    row = 120 + 40 * np.asarray(edges)
    image = np.repeat(np.repeat(row[None, :, None], 300, axis=0), 3, axis=2)
    noisy = image + np.random.default_rng(1).normal(0, noise, image.shape)
    return np.clip(np.round(noisy), 0, 255).astype(np.uint8)


@pytest.mark.parametrize("sigma_px", [0.5, 1.0, 1.5, 2.5])
@pytest.mark.parametrize("noise", [0.0, 3.0])
def test_edge_spread_is_recovered(sigma_px: float, noise: float) -> None:
    # The mask of 9 px and more about an edge cuts off the tails of the widest profiles (s = 3.2 with the larger blur:
    # 5 % beyond +-6 px), and the sum of the box and of two normal curves is no normal curve: together 10 % of s.
    measured = blur_px(step_edges(sigma_px, noise))
    assert measured is not None
    assert measured == pytest.approx(sigma_px, rel=0.1, abs=0.1)


def test_what_a_picture_does_not_show_is_not_measured() -> None:
    assert blur_px(np.full((96, 128, 3), 90, np.uint8)) is None, "without an edge"
    assert noise_of([np.zeros((20, 20, 3), np.uint8)]) is None, "of one plate"
    flat = np.full((480, 640, 3), 120, np.uint8)
    assert not register(flat, flat).conclusive


def test_exposure_counts_clipped_pixels() -> None:
    image = np.full((10, 10, 3), 100, np.uint8)
    image[:2] = 255
    image[5, 5] = (255, 255, 254)
    found = exposure(image)
    assert found.clipped_share == pytest.approx(0.2)
    assert found.mean == pytest.approx(image.mean())


@pytest.mark.parametrize("sigma", [0.5, 1.0, 3.0, 6.0])
def test_noise_of_plates_is_recovered_under_drifting_light(sigma: float) -> None:
    rng = np.random.default_rng(3)
    scene = np.linspace(80, 150, 160)[None, :, None] + np.zeros((120, 160, 3))
    plates = [
        np.clip(np.round(scene + 2 * i + rng.normal(0, sigma, scene.shape)), 0, 255).astype(np.uint8) for i in range(5)
    ]
    plates[2][:32, :32] = 200  # somebody walks through a corner: 2 of 70 blocks
    # Rounding adds 1/12 to the variance. 70 blocks of 256 values in 3 channels: the median of their variances has a
    # standard error of 1.25 sqrt(2/256/210) = 0.8 %, half of it in sigma, four differences of it; 2 % is five of those.
    assert noise_of(plates) == pytest.approx(np.sqrt(sigma**2 + 1 / 12), rel=0.02)
    assert disturbed(plates, sigma)
    assert not disturbed([plates[0], plates[1], plates[3]], sigma)


@pytest.mark.parametrize("gain", [1.0, 0.7, 0.1])
@pytest.mark.parametrize("shift", [(0, 0), (3, -2), (-9, 12)])
def test_movement_of_the_background_is_measured(gain: float, shift: tuple[int, int]) -> None:
    empty, seated = FlatStudio(False, 640, 480), FlatStudio(True, 640, 480)
    moved = np.roll(seated("cam03", 0.0), shift, axis=(1, 0)) * gain
    found = register(np.round(moved).astype(np.uint8), empty("cam03", 0.0))
    assert found.conclusive
    assert found.found > 0.2
    # Each patch is placed to about 0.1 px (0.5 in a dark picture of 10 values); the corners of the image extrapolate
    # the patches' similarity by at most twice their spread.
    assert found.moved_px == pytest.approx(np.hypot(*shift), abs=0.3 if gain > 0.5 else 1.5)


def test_another_cameras_background_is_not_found() -> None:
    empty, seated = FlatStudio(False, 640, 480), FlatStudio(True, 640, 480)
    for one, other in itertools.pairwise(NAMES):
        assert register(seated(one, 0.0), empty(other, 0.0)).found < 0.1


@pytest.mark.slow
@pytest.mark.parametrize("capture", ["scan-a", "draw-b"])
def test_own_and_foreign_backgrounds_of_rendered_captures(capture: str) -> None:
    """What the bounds of rig.acquisition.judgement were set by: renderings that share no code with the studio."""
    from rig.acquisition.judgement import FOUND_LEAST, FOUND_SURELY
    from rig.formats.captures.capture_folder import read_capture

    shot, rig = read_capture(shared(f"data/captures/{capture}"))
    names = rig.names
    for i, name in enumerate(names):
        registration = register(shot.images[name], shot.backgrounds[name][0])
        assert registration.found > FOUND_SURELY
        assert registration.moved_px < 0.5
        foreign = register(shot.images[name], shot.backgrounds[names[i - 1]][0])
        assert foreign.found < FOUND_LEAST
        blur = blur_px(shot.images[name])
        assert blur is not None
        assert blur < 1.5
