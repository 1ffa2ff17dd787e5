"""Compiled loops of ``pipeline.segmentation.foreground``."""

import numpy as np

from rig.jit import njit

MAX_ODDS = 6.0  # log odds are clipped there, so that one pixel cannot outvote its eight neighbours for ever


@njit(cache=True, nogil=True)
def mean_field_sweeps(odds: np.ndarray, residual: np.ndarray, strength: float, sweeps: int) -> np.ndarray:
    """Returns half the log odds (h, w) of each pixel after mean-field sweeps over its eight neighbours, by Gauss-Seidel
    in alternating order.

    ``odds`` (h, w) are the log odds of each pixel by itself. Two neighbours are linked by ``strength``, less the more
    their ``residual`` (h, w, c; standard deviations) differs: the coupling is strength exp(-|difference|^2 / 18), and
    0.71 of that along diagonals.
    """
    height, width = odds.shape
    steps = ((0, 1), (1, 0), (1, 1), (1, -1))
    links = np.zeros((4, height, width), np.float32)
    undecided = undecided_pixels(odds)
    for place in undecided:
        for back in range(2):
            for k in range(4):
                y = place // width - back * steps[k][0]
                x = place % width - back * steps[k][1]
                v, u = y + steps[k][0], x + steps[k][1]
                if y >= 0 and 0 <= x < width and v < height and 0 <= u < width:
                    square = 0.0
                    for c in range(residual.shape[2]):
                        square += (residual[y, x, c] - residual[v, u, c]) ** 2
                    links[k, y, x] = strength * np.exp(-square / 18.0) * (1.0 if k < 2 else 0.7071)
    field = 0.5 * odds
    mean = np.tanh(field)
    for sweep in range(sweeps):
        for step in range(len(undecided)):
            place = undecided[step] if sweep % 2 == 0 else undecided[len(undecided) - 1 - step]
            y, x = place // width, place % width
            total = 0.5 * odds[y, x]
            for k in range(4):
                dy, dx = steps[k]
                if y + dy < height and 0 <= x + dx < width:
                    total += links[k, y, x] * mean[y + dy, x + dx]
                if y - dy >= 0 and 0 <= x - dx < width:
                    total += links[k, y - dy, x - dx] * mean[y - dy, x - dx]
            field[y, x] = total
            mean[y, x] = np.tanh(total)
    return field


@njit(cache=True, nogil=True)
def undecided_pixels(odds: np.ndarray) -> np.ndarray:
    """Returns the pixels (flat indices) that can change: those within two pixels of one whose log odds are not clipped,
    or differ from theirs."""
    height, width = odds.shape
    out = np.empty(height * width, np.int64)
    count = 0
    for y in range(height):
        for x in range(width):
            sure = abs(odds[y, x]) >= MAX_ODDS
            for v in range(max(0, y - 2), min(height, y + 3)):
                for u in range(max(0, x - 2), min(width, x + 3)):
                    sure = sure and odds[v, u] == odds[y, x]
                if not sure:
                    break
            if not sure:
                out[count] = y * width + x
                count += 1
    return out[:count]
