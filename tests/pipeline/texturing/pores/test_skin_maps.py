"""Codes of the maps, and the texture that takes their detail."""

import numpy as np

from pipeline.texturing.layout.uv_unwrap import Atlas, Layout
from pipeline.texturing.pores.relief import COARSE, TexelFrames
from pipeline.texturing.pores.skin_maps import MID_CODE, MM_PER_CODE, codes_of, normal_codes, sharpen_atlas
from rig.colour_space import linear_from_srgb

SIZE, IMAGE_MM = 64, 32.0


def test_heights_come_back_from_their_codes() -> None:
    heights = np.array([[0.0, 0.1, -0.25, 0.7, -0.7]], np.float32)
    codes = codes_of(heights)
    assert codes[0, 0] == MID_CODE
    np.testing.assert_allclose((codes[0, :3].astype(float) - MID_CODE) * MM_PER_CODE, heights[0, :3], atol=MM_PER_CODE)
    assert codes[0, 3] == 65535
    assert codes[0, 4] == 0


def test_normals_lean_away_from_where_the_skin_rises() -> None:
    metric = np.tile(np.array([IMAGE_MM**2, 0.0, IMAGE_MM**2], np.float32), (COARSE, COARSE, 1))
    frames = TexelFrames(metric, np.zeros((COARSE, COARSE, 2), np.float32), np.ones((COARSE, COARSE), np.float32))
    rows, columns = np.mgrid[:SIZE, :SIZE].astype(np.float32) * np.float32(IMAGE_MM / SIZE)
    for heights, wanted in ((0.1 * columns, (-0.1, 0.0, 1.0)), (0.1 * rows, (0.0, 0.1, 1.0))):  # v goes down, y up
        found = normal_codes(heights, slice(8, 24), frames) / 127.5 - 1.0
        unit = np.array(wanted) / np.linalg.norm(wanted)
        np.testing.assert_allclose(found, np.broadcast_to(unit, found.shape), atol=0.005)


def test_brightness_multiplies_the_light_of_a_texture() -> None:
    layout = Layout(np.zeros((3, 2)), np.array([[0, 1, 2]]), np.arange(3))
    image = np.full((4, 4, 3), 100, np.uint8)
    brightness = np.zeros((4, 4), np.float16)
    brightness[1, 2] = np.log(1.5)
    found = sharpen_atlas(Atlas(layout, image), brightness).image
    assert (found[0] == 100).all()
    ratio = linear_from_srgb(found[1, 2] / 255.0) / linear_from_srgb(np.array(100 / 255.0))
    np.testing.assert_allclose(ratio, 1.5, rtol=0.02)
