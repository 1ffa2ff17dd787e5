"""Specks: pieces that the surface encloses go onto it; what may go on behind an outline or lies among others stays."""

import numpy as np

from pipeline.stereo.refinement import take_specks_off

PIXEL_MM, MOST_PX = 2.0, 30


def level() -> tuple[np.ndarray, np.ndarray]:
    return np.full((40, 50), 800.0, np.float32), np.zeros((40, 50, 2), np.float32)


def test_enclosed_piece_is_laid_onto_the_surface() -> None:
    depth, slopes = level()
    depth[10:15, 20:25] = 820.0
    specks = take_specks_off(depth, slopes, PIXEL_MM, MOST_PX)
    assert specks.sum() == 25
    assert specks[10:15, 20:25].all()
    assert np.abs(depth - 800.0).max() < 1e-3


def test_piece_at_the_edge_of_the_picture_stays() -> None:
    depth, slopes = level()
    depth[36:, 20:24] = 820.0
    before = depth.copy()
    assert not take_specks_off(depth, slopes, PIXEL_MM, MOST_PX).any()
    assert (depth == before).all()


def test_piece_at_an_outline_stays() -> None:
    depth, slopes = level()
    depth[:, 30:] = 0.0
    depth[10:14, 27:30] = 780.0
    before = depth.copy()
    assert not take_specks_off(depth, slopes, PIXEL_MM, MOST_PX).any()
    assert (depth == before).all()


def test_pieces_beside_each_other_stay_where_together_they_are_large() -> None:
    depth, slopes = level()
    depth[10:15, 10:15], depth[10:15, 15:20] = 820.0, 840.0
    depth[25:29, 10:13], depth[25:29, 13:16] = 820.0, 840.0
    specks = take_specks_off(depth, slopes, PIXEL_MM, MOST_PX)
    assert not specks[:20].any()
    assert specks[25:29, 10:16].all()
    assert specks.sum() == 24
