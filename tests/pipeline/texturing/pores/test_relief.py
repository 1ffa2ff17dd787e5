"""Relief and detail of skin on a flat sheet, whose two sets of views are painted pictures."""

import cv2
import numpy as np
import pytest

from pipeline.texturing.layout.uv_unwrap import Layout
from pipeline.texturing.paint_kernels import Pictures
from pipeline.texturing.pores.relief import (
    COARSE,
    HalfPictures,
    Patches,
    SkinDetail,
    Strips,
    TexelFrames,
    estimate_detail,
    remove_slow,
)
from pipeline.texturing.pores.skin_maps import plain_choice
from pipeline.texturing.visibility import window_table
from rig.colour_space import linear_from_srgb, srgb_from_linear

SIZE, TEXEL_MM, SLOPE_OF_LIGHT = 256, 0.1, (0.5, 0.2)
SIDE_MM = SIZE * TEXEL_MM


def waves(seed: int, shortest_mm: float = 0.6, longest_mm: float = 3.0) -> np.ndarray:
    """Random heights (0.03 mm) over the sheet."""
    noise = np.fft.rfft2(np.random.default_rng(seed).standard_normal((SIZE, SIZE)))
    down, across = np.meshgrid(np.fft.fftfreq(SIZE), np.fft.rfftfreq(SIZE), indexing="ij")
    per_mm = np.hypot(down, across) / TEXEL_MM
    kept = (per_mm > 1 / longest_mm) & (per_mm < 1 / shortest_mm)
    field = np.fft.irfft2(noise * kept / np.maximum(per_mm, 1e-3), (SIZE, SIZE))
    return 0.03 * field / field.std()


def shaded(heights_mm: np.ndarray) -> np.ndarray:
    """The logarithm of the light on them."""
    down, across = np.gradient(heights_mm, TEXEL_MM)
    return -(SLOPE_OF_LIGHT[0] * across + SLOPE_OF_LIGHT[1] * down)


def detail_of(full: list[np.ndarray], work: list[np.ndarray]) -> SkinDetail:
    """What is found where two views show these logarithms of light."""
    uv = np.array([[0.0, 0.0], [1.0, 0.0], [1.0, 1.0], [0.0, 1.0]])
    layout = Layout(uv, np.array([[0, 2, 1], [0, 3, 2]]), np.arange(4))
    halves = []
    for view in (0, 1):
        shares = np.ones((4, 1), np.float32)
        halves.append(plain_choice(np.full((4, 1), view, np.int32), shares, np.ones((2, 4), np.float32)))
    flat = np.array([SIDE_MM**2, 0.0, SIDE_MM**2], np.float32)
    light = np.array(SLOPE_OF_LIGHT, np.float32) / np.float32(SIDE_MM)
    frames = TexelFrames(
        np.tile(flat, (COARSE, COARSE, 1)), np.tile(light, (COARSE, COARSE, 1)), np.ones((COARSE, COARSE), np.float32)
    )
    pair = HalfPictures(packed(full, uv), packed(work, uv), (halves[0], halves[1]))
    return estimate_detail(Strips.of(layout, SIZE), pair, frames)


def packed(logs: list[np.ndarray], uv: np.ndarray) -> Pictures:
    grey = linear_from_srgb(np.array(128 / 255.0))
    codes = [np.rint(255 * srgb_from_linear(np.clip(grey * np.exp(log), 0, 1))).astype(np.uint8) for log in logs]
    stored = np.concatenate([np.repeat(code[:, :, None], 3, axis=2).ravel() for code in codes])
    first = np.array([k * 3 * SIZE * SIZE for k in range(len(logs))], np.int64)
    sides = np.full(len(logs), SIZE, np.int64)
    places = np.tile((SIZE * uv - 0.5).astype(np.float32), (len(logs), 1, 1))
    return Pictures(stored, first, sides, sides, places, window_table(0.3))


def correlation(found: np.ndarray, true: np.ndarray) -> float:
    inner = slice(40, -40)
    return float(np.corrcoef(found[inner, inner].ravel(), true[inner, inner].ravel())[0, 1])


@pytest.fixture(scope="module")
def flat() -> list[np.ndarray]:
    return [np.zeros((SIZE, SIZE))] * 2


def test_relief_is_found_from_its_shading(flat: list[np.ndarray]) -> None:
    heights = waves(1)
    rng = np.random.default_rng(2)
    found = detail_of([shaded(heights) + 0.02 * rng.standard_normal(heights.shape) for _ in range(2)], flat)
    assert correlation(found.heights_mm, heights) > 0.8
    assert found.heights_mm.std() > 0.5 * heights.std()


def test_what_does_not_repeat_is_no_relief(flat: list[np.ndarray]) -> None:
    found = detail_of([shaded(waves(3)), shaded(waves(4))], flat)
    alone = detail_of([shaded(waves(3))] * 2, flat)
    assert np.abs(found.heights_mm).mean() < 0.25 * np.abs(alone.heights_mm).mean()
    assert max(found.repeated[:3]) < 0.3 < min(alone.repeated[:3])


def test_a_shift_between_the_two_sets_is_taken_out(flat: list[np.ndarray]) -> None:
    heights = waves(5)
    moved = [np.roll(shaded(heights), shift, axis=1) for shift in (-1, 1)]  # 0.2 mm apart
    assert correlation(detail_of(moved, flat).heights_mm, heights) > 0.8


def test_brightness_is_what_pictures_of_work_size_lack() -> None:
    fine, slow = 0.1 * waves(6, 0.4, 0.8) / 0.03, 0.1 * waves(7, 1.5, 3.0) / 0.03
    found = detail_of([fine + slow] * 2, [slow] * 2).brightness.astype(float)
    assert correlation(found, fine) > 0.9
    assert abs(correlation(found, slow)) < 0.1


def test_waves_keep_their_lengths_in_a_stretched_layout() -> None:
    patches = Patches.of(32, np.array([[0.04, 0.0, 0.01]]), np.zeros((1, 2)))  # 0.2 by 0.1 mm a texel
    assert patches.per_mm[0, 0, 4] == pytest.approx(4 / 32 / 0.2)
    assert patches.per_mm[0, 4, 0] == pytest.approx(4 / 32 / 0.1)
    light = Patches.of(32, np.array([[0.01, 0.0, 0.01]]), np.array([[5.0, 0.0]]))  # dh/du times 5 for each texel
    row = np.sin(2 * np.pi * 4 * np.arange(32) / 32)
    shading = np.fft.rfft2(np.tile(-5.0 * 2 * np.pi * 4 / 32 * np.cos(2 * np.pi * 4 * np.arange(32) / 32), (1, 32, 1)))
    relief, _ = light.relief(shading.astype(np.complex64), shading.astype(np.complex64))
    drawn = np.fft.irfft2(relief, (32, 32))[0, 0]
    assert float(np.corrcoef(drawn, row)[0, 1]) > 0.99


@pytest.mark.parametrize("side", [16, 32, 128])
def test_slow_waves_are_those_of_a_gaussian(side: int) -> None:
    """On fewer texels it comes out the same to half a percent of what stays, up to the strip's borders."""
    light = np.random.default_rng(side).standard_normal((side, 9 * side)).astype(np.float32)
    light += np.linspace(0.0, 30.0, 9 * side, dtype=np.float32)
    plain = light - cv2.GaussianBlur(light, (0, 0), side / 6.0, borderType=cv2.BORDER_REFLECT)
    found = remove_slow(light, side)
    assert found.std() == pytest.approx(1.0, rel=0.05)
    assert np.abs(found - plain)[:, side:-side].max() < 0.005 * plain.std()
