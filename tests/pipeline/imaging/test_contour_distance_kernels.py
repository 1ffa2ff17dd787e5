"""The compiled loops of contour distance beside plain ones: marching squares cell by cell, and the nearest of all
pieces for every pixel."""

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from hypothesis.extra import numpy as arrays

from pipeline.imaging.masks import BAND_PX, distance_to_level, fill_holes
from pipeline.imaging.sampling_kernels import refine_distance, segments_of_level
from pipeline.imaging.silhouette import signed_distance

LEVEL = 0.5
# Greys of eight bits never lie at the level itself, as those of masks do not.
FIELDS = arrays.arrays(np.uint8, st.tuples(st.integers(2, 9), st.integers(2, 9))).map(
    lambda greys: (greys.astype(np.float32) + np.float32(0.25)) / 256
)


def naive_segments(field: np.ndarray, level: float) -> list[tuple[int, int, frozenset[tuple[float, float]]]]:
    """A cell and the two ends of a piece, in any order. Of four crossings the mean of the corners says which are
    joined: the piece cuts off a corner whose side the mean is not on."""
    pieces = []
    height, width = field.shape
    for y in range(height - 1):
        for x in range(width - 1):
            ring = [(x, y), (x + 1, y), (x + 1, y + 1), (x, y + 1)]
            values = [float(field[row, column]) - level for column, row in ring]
            crossings = {}
            for k in range(4):
                v, w = values[k], values[(k + 1) % 4]
                if (v > 0) != (w > 0):
                    share = v / (v - w)
                    (x0, y0), (x1, y1) = ring[k], ring[(k + 1) % 4]
                    crossings[k] = (x0 + share * (x1 - x0), y0 + share * (y1 - y0))
            if len(crossings) == 2:
                pieces.append((x, y, frozenset(crossings.values())))
            elif len(crossings) == 4:
                mean_above = sum(values) > 0
                for k in range(4):  # a corner on the other side than the mean, between the edges k - 1 and k
                    if (values[k] > 0) != mean_above:
                        pieces.append((x, y, frozenset((crossings[(k - 1) % 4], crossings[k]))))
    return pieces


def rounded(pieces: list[tuple[int, int, frozenset[tuple[float, float]]]]) -> list[tuple]:
    return sorted((x, y, tuple(sorted((round(u, 3), round(v, 3)) for u, v in ends))) for x, y, ends in pieces)


@given(FIELDS)
def test_pieces_are_those_of_marching_squares(field: np.ndarray) -> None:
    found = segments_of_level(field, LEVEL)
    # 1/4 of the cells and 16 is all the room there is: noise on every pixel has more pieces, outlines never do
    expected = rounded(naive_segments(field, LEVEL))
    pieces = [(int(r[4]), int(r[5]), frozenset(((r[0], r[1]), (r[2], r[3])))) for r in found.astype(float)]
    if len(expected) <= field.size // 4 + 14:
        assert len(pieces) == len(expected)
        for (x, y, ends), (u, v, others) in zip(rounded(pieces), expected, strict=True):
            assert (x, y) == (u, v)
            np.testing.assert_allclose(ends, others, atol=2e-3)


def test_a_closed_outline_has_no_end() -> None:
    y, x = np.mgrid[:40, :50].astype(np.float32)
    field = np.clip(0.5 - (np.hypot(x - 24.3, y - 19.2) - 11.7) / 4, 0, 1).astype(np.float32)
    segments = segments_of_level(field, LEVEL)
    ends, counts = np.unique(np.round(segments[:, :4].reshape(-1, 2), 3), axis=0, return_counts=True)
    assert (counts == 2).all()
    length = np.linalg.norm(segments[:, 2:4] - segments[:, :2], axis=1).sum()
    assert length == pytest.approx(2 * np.pi * 11.7, rel=0.003)
    assert np.abs(np.hypot(*(ends - [24.3, 19.2]).T) - 11.7).max() < 0.02


def test_what_crosses_nothing_has_no_piece() -> None:
    assert len(segments_of_level(np.zeros((5, 6), np.float32), LEVEL)) == 0
    assert len(segments_of_level(np.ones((5, 6), np.float32), LEVEL)) == 0


@pytest.mark.parametrize("band", [3, 12])
def test_within_the_band_every_pixel_has_the_distance_to_the_nearest_piece(band: int) -> None:
    rng = np.random.default_rng(6)
    y, x = np.mgrid[:48, :60].astype(np.float32)
    field = np.clip(0.5 - (np.hypot(x - 20, (y - 22) * 1.3) - 12 + rng.normal(scale=0.3, size=x.shape)) / 6, 0, 1)
    field = field.astype(np.float32)
    segments = segments_of_level(field, LEVEL)
    start = np.where(field > LEVEL, np.float32(-100), np.float32(100))
    whole = start.copy()
    refine_distance(whole, field, LEVEL, segments, band)
    nearest = np.min([_distances(row.astype(float), x, y) for row in segments], axis=0)
    # A piece is asked by pixels up to `band` columns and rows away: what lies within band - 1 has met its nearest one.
    inner = nearest < band * 2 / 3
    signed = np.where(field > LEVEL, -nearest, nearest)
    assert inner.sum() > 200
    np.testing.assert_allclose(whole[inner], signed[inner], atol=1e-3)
    beyond = nearest > band * np.sqrt(2) + 1
    assert beyond.any()
    np.testing.assert_array_equal(whole[beyond], start[beyond])
    between = (nearest > band * 2 / 3 + 0.01) & (nearest < band - 1)
    assert (np.abs(whole[between]) > nearest[between]).all(), "blended with what was there, 100"
    assert (np.sign(whole) == np.sign(start))[field != LEVEL].all()


def _distances(piece: np.ndarray, x: np.ndarray, y: np.ndarray) -> np.ndarray:
    start, end = piece[:2], piece[2:4]
    along = end - start
    share = ((x - start[0]) * along[0] + (y - start[1]) * along[1]) / max(along @ along, 1e-12)
    share = np.clip(share, 0, 1)
    return np.hypot(x - start[0] - share * along[0], y - start[1] - share * along[1])


def grid(size: int = 160) -> tuple[np.ndarray, np.ndarray]:
    y, x = np.mgrid[:size, :size].astype(np.float64)
    return x, y


@given(st.floats(70, 90), st.floats(70, 90), st.floats(20, 55))
def test_a_circle_is_met_to_hundredths_of_a_pixel(cx: float, cy: float, radius: float) -> None:
    x, y = grid()
    truth = np.hypot(x - cx, y - cy) - radius
    found = distance_to_level(np.clip(0.5 - truth / 4, 0, 1).astype(np.float32))
    near = np.abs(truth) < BAND_PX / 2
    # The chord of a pixel's arc lies 1 / (8 r) = 0.006 px inside; the ramp's linear interpolation is as good.
    assert np.abs(found - truth)[near].max() < 0.05
    far = np.abs(truth) >= BAND_PX
    assert (np.abs(found - truth)[far] < 0.75 + 0.03 * np.abs(truth[far])).all()


def test_a_slanted_edge_has_no_bias() -> None:
    x, y = grid()
    truth = (x - 80.3) * np.cos(0.4) + (y - 79.1) * np.sin(0.4)
    found = distance_to_level(np.clip(0.5 - truth / 3, 0, 1).astype(np.float32))
    near = (np.abs(truth) < 6) & (x > 20) & (x < 140) & (y > 20) & (y < 140)
    assert abs((found - truth)[near].mean()) < 1e-4
    assert np.abs(found - truth)[near].max() < 0.05  # where the propagation took the second nearest piece


@pytest.mark.parametrize("value", [0.0, 1.0])
def test_without_a_contour_everything_is_farther_than_any_pixel_and_has_slopes(value: float) -> None:
    far = -90.0 if value else 90.0
    field = np.full((40, 50), value, np.float32)
    np.testing.assert_array_equal(distance_to_level(field), far)
    np.testing.assert_array_equal(signed_distance(field > 0.5), far)


def test_the_sign_is_the_level_even_where_corners_touch() -> None:
    field = np.zeros((12, 12), np.float32)
    field[3:6, 3:6] = field[6:9, 6:9] = 1.0
    found = distance_to_level(field)
    np.testing.assert_array_equal(found < 0, field > 0.5)
    assert np.abs(found[4, 4] + 1.5) < 1e-6


def test_what_is_enclosed_is_filled_and_what_reaches_the_border_is_not() -> None:
    mask = np.zeros((12, 14), bool)
    mask[2:10, 2:10] = True
    mask[4:6, 4:6] = False  # enclosed
    mask[7, 7:14] = False  # a notch
    mask[10:, 5:7] = True  # the subject leaves the picture
    filled = fill_holes(mask)
    assert filled[4:6, 4:6].all()
    assert not filled[7, 7:].any()
    assert (filled & ~mask).sum() == 4
    assert not mask[4:6, 4:6].any()

    corners = fill_holes(~np.eye(6, dtype=bool))  # gaps that touch at their corners alone
    assert (corners[2, 2], corners[0, 0], corners[5, 5]) == (True, False, False)
    assert fill_holes(np.ones((3, 4), bool)).all()
    assert not fill_holes(np.zeros((3, 4), bool)).any()
