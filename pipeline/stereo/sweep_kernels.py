"""Compiled loops of the first search: depths at even steps are tried along every ray, and neighbouring rays then
agree; and those that improve them: planes taken over from neighbours, and steps of least squares."""

import numpy as np

from pipeline.stereo.matching_kernels import (
    AGAINST,
    NO_SAY,
    UNSEEN_PX,
    Loaded,
    correlate_and_slide,
    distance_there,
    farthest,
    load_window,
    match,
    place_window,
)
from rig.jit import njit

MIN_CORRELATION = 0.3  # correlation of a view that may speak
BEHIND_BEST = 0.35  # a view that is less alike than the best by this is taken for hidden
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


@njit(cache=True, nogil=True, error_model="numpy", fastmath=True, allocates=False)
def propagate(sight, scratch, parity, steps, same_mm, fresh, depth, slopes, cost):
    """Lets every pixel of one colour of the chequerboard (``parity``) try the planes of its neighbours of the other
    colour, ``steps`` pixels away (odd), and keeps the best of these and its own. Changes ``fresh``, ``depth``,
    ``slopes`` and ``cost`` (h, w) in place.

    A cost below 0 is not yet known. A plane that differs from the current one by less than ``same_mm``, at the pixel
    and one pixel beside it, is not tried. ``fresh`` marks planes that their neighbours have not tried yet; a pixel
    whose cost is known tries only those. Planes taken over here become fresh.
    """
    height, width = depth.shape
    window, scores, place = scratch.window, scratch.scores, scratch.place
    reach = farthest(sight.pattern)
    for row in range(height):
        for column in range((row + parity) % 2, width, 2):
            best = cost[row, column]
            if depth[row, column] <= 0.0 or (best >= 0.0 and not _is_beside(fresh, row, column, steps)):
                continue
            total, energy = load_window(sight, width, height, column, row, window)
            loaded = Loaded(column, row, window, total, energy)
            best_z, best_x, best_y = depth[row, column], slopes[row, column, 0], slopes[row, column, 1]
            known = best >= 0.0
            if not known:
                best = cost_of(sight, loaded, best_z, best_x, best_y, reach, place, scores)
            for step in steps:
                for side in range(4):
                    i = (step, -step, 0, 0)[side]
                    j = (0, 0, step, -step)[side]
                    if not (0 <= column + i < width and 0 <= row + j < height):
                        continue
                    there = depth[row + j, column + i]
                    if there <= 0.0 or (known and not fresh[row + j, column + i]):
                        continue
                    z_x, z_y = slopes[row + j, column + i, 0], slopes[row + j, column + i, 1]
                    z = there - i * z_x - j * z_y
                    if abs(z - best_z) < same_mm and abs(z_x - best_x) + abs(z_y - best_y) < same_mm:
                        continue
                    value = cost_of(sight, loaded, z, z_x, z_y, reach, place, scores)
                    if value < best:
                        best, best_z, best_x, best_y = value, z, z_x, z_y
                        fresh[row, column] = True
            cost[row, column] = best
            depth[row, column] = best_z
            slopes[row, column, 0] = best_x
            slopes[row, column, 1] = best_y


@njit(cache=True, nogil=True, error_model="numpy", inline="always")
def _is_beside(fresh, row, column, steps):
    height, width = fresh.shape
    for step in steps:
        if (
            (column + step < width and fresh[row, column + step])
            or (column >= step and fresh[row, column - step])
            or (row + step < height and fresh[row + step, column])
            or (row >= step and fresh[row - step, column])
        ):
            return True
    return False


@njit(cache=True, nogil=True, error_model="numpy", fastmath=True, allocates=False)
def slide(sight, scratch, most_px, depth, slopes, place_mm, information, likeness):
    """Makes one step of least squares on the depth of every pixel (h, w), with all views in which it looks alike.

    Fills ``place_mm`` (the new depth, at most ``most_px`` away in the view that is most sensitive to it), its
    ``information`` (mm^-2, samples taken as independent; 0 where nothing is known), and ``likeness``, the mean
    correlation.
    """
    height, width = depth.shape
    ways, window, place, found = sight.ways, scratch.window, scratch.place, scratch.found
    reach = farthest(sight.pattern)
    for row in range(height):
        for column in range(width):
            z = depth[row, column]
            place_mm[row, column] = z
            information[row, column] = 0.0
            likeness[row, column] = 0.0
            if z <= 0.0:
                continue
            total, energy = load_window(sight, width, height, column, row, window)
            loaded = Loaded(column, row, window, total, energy)
            best, fastest, count = 0.0, 0.0, 0
            for k in range(len(ways)):
                if not place_window(
                    ways[k], z, slopes[row, column, 0], slopes[row, column, 1], column, row, reach, place
                ):
                    continue
                beside = distance_there(ways[k], place, sight.distance_px)
                if beside > 0.0 or beside < UNSEEN_PX:
                    continue
                correlate_and_slide(ways[k], place, sight, loaded, found[count])
                best = max(best, found[count, 0])
                fastest = max(fastest, place[6] * place[6] + place[7] * place[7])
                count += 1
            gradient, curvature, mean, spoke = 0.0, 0.0, 0.0, 0
            for k in range(count):
                if found[k, 0] > MIN_CORRELATION and found[k, 0] > best - BEHIND_BEST:
                    gradient += found[k, 1]
                    curvature += found[k, 2]
                    mean += found[k, 0]
                    spoke += 1
            if spoke > 0 and curvature > 0.0:
                most = most_px / np.sqrt(fastest)
                place_mm[row, column] = z + min(max(gradient / curvature, -most), most)
                # Noise resembles itself by chance: a window counts by the share of its contrast that is not noise.
                information[row, column] = curvature * max(
                    1.0 - total * sight.noise * sight.noise / max(energy, 1e-6), 0.0
                )
                likeness[row, column] = mean / spoke
