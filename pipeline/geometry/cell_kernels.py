"""Compiled loop that finds what lies near a point, among points sorted into cubic cells."""

import numpy as np

from rig.jit import njit

COLUMNS = 9  # of three cells each: those about a cell, and it


@njit(cache=True, nogil=True)
def columns_about(cell: int, keys: np.ndarray, spans: np.ndarray, ranges: np.ndarray) -> None:
    """Fills ``ranges`` (9, 2): where the points of the 27 cells around ``cell`` begin and end in the sorted ``keys``.
    Three cells that are adjacent in z have consecutive keys, so that nine ranges suffice. ``keys`` and ``spans`` are
    those of ``cells.Cells``."""
    for column in range(COLUMNS):
        low = cell + ((column // 3 - 1) * spans[1] + column % 3 - 1) * spans[2] - 1
        ranges[column, 0] = np.searchsorted(keys, low)
        ranges[column, 1] = np.searchsorted(keys, low + 3)
