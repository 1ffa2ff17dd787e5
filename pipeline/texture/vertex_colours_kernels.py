"""Compiled loops of ``pipeline.texture.vertex_colours``."""

import numpy as np

from pipeline.compiled import njit

LEAST_SHARE = 0.005  # of a vertex's weight: a view with less has not coloured it


@njit(cache=True, nogil=True)
def blend_views(weights: np.ndarray, colours: np.ndarray, highlight: float) -> tuple[np.ndarray, np.ndarray]:
    """Weighted mean of each vertex, views that are brighter than its weighted median counting less; and their number.

    ``highlight`` is the excess over the median, by its level, at which a view counts half.
    """
    cameras, count = weights.shape
    out = np.zeros((count, 3))
    views = np.zeros(count, np.uint8)
    luminance, order, ranks = np.zeros(cameras), np.zeros(cameras, np.int64), np.zeros(cameras, np.int64)
    for v in range(count):
        n, total = 0, 0.0
        for k in range(cameras):
            if weights[k, v] > 0:
                luminance[n] = 0.21 * colours[k, v, 0] + 0.72 * colours[k, v, 1] + 0.07 * colours[k, v, 2]
                order[n] = k
                total += weights[k, v]
                n += 1
        if n == 0:
            continue
        for i in range(n):  # sorted by insertion: NumPy's sorting took a second to compile
            place = i
            while place > 0 and luminance[ranks[place - 1]] > luminance[i]:
                ranks[place] = ranks[place - 1]
                place -= 1
            ranks[place] = i
        middle, passed = luminance[ranks[n - 1]], 0.0
        for i in range(n):
            passed += weights[order[ranks[i]], v]
            if passed >= 0.5 * total:
                middle = luminance[ranks[i]]
                break
        norm = 0.0
        for i in range(n):
            excess = max(0.0, luminance[i] - middle) / (highlight * middle + 0.005)
            weight = weights[order[i], v] / (1.0 + excess * excess)
            norm += weight
            for c in range(3):
                out[v, c] += weight * colours[order[i], v, c]
        for c in range(3):
            out[v, c] /= norm
        for i in range(n):
            views[v] += weights[order[i], v] > LEAST_SHARE * total
    return out, views
