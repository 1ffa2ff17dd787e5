"""Compiled loops of ``pipeline.texturing.vertex_colours``."""

import numpy as np

from rig.jit import njit

OUTLIER = 0.12  # difference from the median of the views, by its level, at which a brighter view counts half
DARKER = 0.5  # of a difference, where a view is darker: most are shading that turns with the surface, few are shadows
MAX_VOTE = 0.7  # of a view about the median, by the mean weight: a close-up that a shadow lies in is one of many
MIN_SHARE = 0.005  # of a vertex's weight: a view with less has not coloured it


@njit(cache=True, nogil=True)
def blend_views(weights: np.ndarray, colours: np.ndarray, outlier: float) -> tuple[np.ndarray, np.ndarray]:
    """Returns the mean colour (v, 3) of each vertex over the views, weighted by ``weights`` (k, v), and the number of
    views that contribute. Views that differ from the weighted median of a channel count less. ``colours`` (k, v, 3) are
    linear.

    ``outlier`` is the difference from the median, relative to the median, at which a brighter view (a highlight) counts
    half. A darker view (a shadow that it alone sees) counts half at twice that.
    """
    cameras, count = weights.shape
    out = np.zeros((count, 3))
    views = np.zeros(count, np.uint8)
    order, ranks, middle = np.zeros(cameras, np.int64), np.zeros(cameras, np.int64), np.zeros(3)
    for v in range(count):
        n, total = 0, 0.0
        for k in range(cameras):
            if weights[k, v] > 0:
                order[n] = k
                total += weights[k, v]
                n += 1
        if n == 0:
            continue
        cap, votes = MAX_VOTE * total / n, 0.0
        for i in range(n):
            votes += min(weights[order[i], v], cap)
        for c in range(3):
            for i in range(n):  # sorted by insertion: NumPy's sorting took a second to compile
                value, place = colours[order[i], v, c], i
                while place > 0 and colours[ranks[place - 1], v, c] > value:
                    ranks[place] = ranks[place - 1]
                    place -= 1
                ranks[place] = order[i]
            middle[c], passed = colours[ranks[n - 1], v, c], 0.0
            for i in range(n):
                passed += min(weights[ranks[i], v], cap)
                if passed >= 0.5 * votes:
                    middle[c] = colours[ranks[i], v, c]
                    break
        norm = 0.0
        for i in range(n):
            k, off = order[i], 0.0
            for c in range(3):
                part = (colours[k, v, c] - middle[c]) / (outlier * max(middle[c], 0.0) + 0.005)
                part *= 1.0 if part > 0.0 else DARKER
                off += part * part / 3.0
            weight = weights[k, v] / (1.0 + off)
            norm += weight
            for c in range(3):
                out[v, c] += weight * colours[k, v, c]
        for c in range(3):
            out[v, c] /= norm
        for i in range(n):
            views[v] += weights[order[i], v] > MIN_SHARE * total
    return out, views
