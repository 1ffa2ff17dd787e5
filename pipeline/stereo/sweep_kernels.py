"""Compiled loops of the first search: depths at even steps are tried along every ray, and neighbouring rays then
agree."""

import numpy as np

from pipeline.stereo.matching_kernels import AGAINST, NO_SAY, Loaded, farthest, load_window, match
from rig.jit import njit

NOT_COMPARED = 1.0  # cost of a place that no pair of views says anything about: that of no likeness
ALONE = 0.15  # cost of a place that a single other view speaks for


@njit(cache=True, nogil=True, error_model="numpy", fastmath=True, inline="always")
def score_best_half(scores, count):
    """Returns a cost: 1 less the mean of the better half of the first ``count`` scores (two at least), since the point
    may be hidden from the other views. Sorts ``scores``. A single score costs ``ALONE`` more; none costs
    ``NOT_COMPARED``."""
    for i in range(1, count):  # insertion sort, falling
        value = scores[i]
        j = i - 1
        while j >= 0 and scores[j] < value:
            scores[j + 1] = scores[j]
            j -= 1
        scores[j + 1] = value
    if count == 0:
        return NOT_COMPARED
    kept = min(max((count + 1) // 2, 2), count)
    mean = 0.0
    for i in range(kept):
        mean += scores[i]
    return 1.0 - mean / kept + (ALONE if count == 1 else 0.0)


@njit(cache=True, nogil=True, error_model="numpy", fastmath=True, inline="always")
def cost_of(sight, loaded, z, z_x, z_y, reach, place, scores):
    """Returns the matching cost (0 to 2) of the loaded window with the other views if the surface is the given plane.
    It is 2 if a view shows the point outside the subject."""
    count = 0
    for k in range(len(sight.ways)):
        score = match(sight.ways[k], sight, loaded, z, z_x, z_y, reach, place)
        if score == AGAINST:
            return 1.0 - AGAINST
        if score < NO_SAY:
            scores[count] = score
            count += 1
    return score_best_half(scores, count)


@njit(cache=True, nogil=True, error_model="numpy", fastmath=True, allocates=False)
def sweep_view(sight, scratch, near, far, slopes, strides, cost):
    """Fills ``cost`` (h, w, labels) with the matching costs at evenly spaced depths from ``near`` to ``far`` (h, w;
    mm).

    ``slopes`` (h, w, 4) are those of near by x and y, and of far by x and y, mm per pixel. ``strides`` (h, w): only
    every n-th depth is matched, and the last; costs between are interpolated linearly.
    """
    height, width, labels = cost.shape
    window, scores, place = scratch.window, scratch.scores, scratch.place
    reach = farthest(sight.pattern)
    for row in range(height):
        for column in range(width):
            if far[row, column] <= 0.0:
                cost[row, column] = NOT_COMPARED
                continue
            total, energy = load_window(sight, width, height, column, row, window)
            loaded = Loaded(column, row, window, total, energy)
            d, before = 0, 0
            while True:
                share = d / (labels - 1.0)
                z = near[row, column] + share * (far[row, column] - near[row, column])
                z_x = slopes[row, column, 0] + share * (slopes[row, column, 2] - slopes[row, column, 0])
                z_y = slopes[row, column, 1] + share * (slopes[row, column, 3] - slopes[row, column, 1])
                value = cost_of(sight, loaded, z, z_x, z_y, reach, place, scores)
                for between in range(before + 1, d):
                    there = (between - before) / (d - before)
                    cost[row, column, between] = (1.0 - there) * cost[row, column, before] + there * value
                cost[row, column, d] = value
                if d == labels - 1:
                    break
                d, before = min(d + strides[row, column], labels - 1), d


@njit(cache=True, nogil=True, error_model="numpy", fastmath=True)
def aggregate(cost, live, small, large, out):
    """Fills ``out`` (h, w, labels) with the sum, over four directions, of the cost of the cheapest path through the
    image that ends at this pixel and label.

    Hirschmueller, Stereo processing by semiglobal matching, 2008 (https://doi.org/10.1109/TPAMI.2007.1166), eq. (13): a
    change of one label along the path costs ``small``, a larger one ``large``. Paths start anew at pixels that are not
    ``live``.
    """
    height, width, labels = cost.shape
    out[:] = 0.0
    before, now = np.empty(labels, np.float32), np.empty(labels, np.float32)
    for way in range(4):
        lines = height if way < 2 else width
        length = width if way < 2 else height
        for line in range(lines):
            started = False
            least = np.float32(0.0)
            for step in range(length):
                along = step if way % 2 == 0 else length - 1 - step
                row, column = (line, along) if way < 2 else (along, line)
                if not live[row, column]:
                    started = False
                    continue
                lowest = np.float32(1e9)
                for d in range(labels):
                    value = cost[row, column, d]
                    if started:
                        best = min(before[d], least + large)
                        if d > 0:
                            best = min(best, before[d - 1] + small)
                        if d < labels - 1:
                            best = min(best, before[d + 1] + small)
                        value += best - least
                    now[d] = value
                    out[row, column, d] += value
                    lowest = min(lowest, value)
                for d in range(labels):
                    before[d] = now[d]
                least = lowest
                started = True
