"""Contains the compiled loops that match a window of one view with another view. The window lies on a plane, which maps
it to the other view.

Scores are zero-mean normalised cross-correlations, so that gain and offset of a camera have no effect. The norms
include the noise of the two views, so a window without texture has a low correlation with all others.

A *way* is a row of 16 numbers (``Stack.homographies``) that maps a pixel and its depth to another view, and gives the
position of this view's pixels in memory. A *shade* is the unit in which ``Stack`` stores grey values.

``sweep_view`` and ``aggregate`` search the first depths; ``propagate`` and ``slide`` refine them.
"""

from typing import NamedTuple

import numpy as np

from pipeline.geometry.projection_kernels import NEAREST_MM, turned
from pipeline.imaging.sampling_kernels import bilinear, bilinear_slopes
from rig.jit import njit

MIN_CORRELATION = 0.3  # correlation of a view that may speak
BEHIND_BEST = 0.35  # a view that is less alike than the best by this is taken for hidden
NOT_COMPARED = 1.0  # cost of a place that no pair of views says anything about: that of no likeness
ALONE = 0.15  # cost of a place that a single other view speaks for
NO_SAY = 2.0  # a score that says nothing: the view does not see the place
AGAINST = -1.0  # the view shows the place beside the subject
BESIDE_PX = 2.0  # that far beside its outline
WINDOW_PX = -1.0  # to the outline: nearer samples hold background, whose edge would be matched for the surface
UNSEEN_PX = -1e4  # distances below are beyond the photograph
MIN_AREA = 0.05  # of a pixel in the other view: flatter, or from behind, it is not compared
WIDTH, HEIGHT, START, NOISE = 12, 13, 14, 15  # entries of a way, behind rotation and translation
LOW = np.uint32(0xFFFF)
HIGH = np.uint32(16)


class Sight(NamedTuple):
    """Holds a view to match, and the other views and parameters of the matching."""

    start: int  # of its first pixel
    noise: float  # shades
    ways: np.ndarray  # to the views that it is compared with, as ``Stack.homographies`` has them
    pairs: np.ndarray  # all views' pixels, as ``Stack`` has them
    distance_px: np.ndarray
    pattern: np.ndarray  # samples of a window, across and down from its middle, px
    contrast: float  # shades at which a sample counts half


class Scratch(NamedTuple):
    """Holds working arrays that the loops of one view reuse."""

    window: np.ndarray  # zero-mean shades, weights
    scores: np.ndarray  # of the views that it is compared with
    place: np.ndarray  # by ``place_window``
    found: np.ndarray  # by ``correlate_and_slide``, for each of the views


def make_scratch(sight: Sight) -> Scratch:
    """Allocates the working arrays for a view, which only one thread may use at a time."""
    count, samples = len(sight.ways), sight.pattern.shape[1]
    return Scratch(np.empty((2, samples), np.float32), np.empty(count), np.empty(8), np.empty((count, 3)))


class Loaded(NamedTuple):
    """Holds the window around one pixel, as ``load_window`` fills it."""

    column: int
    row: int
    window: np.ndarray  # zero-mean shades, weights
    total: float  # of the weights
    energy: float  # of the weighted squares


@njit(cache=True, nogil=True, error_model="numpy", allocates=False)
def farthest(pattern):
    """Returns the largest distance (px, across or down) of a sample of ``pattern`` (2, s) from the window's middle."""
    reach = np.float32(0.0)
    for i in range(pattern.shape[1]):
        reach = max(reach, abs(pattern[0, i]), abs(pattern[1, i]))
    return reach


@njit(cache=True, nogil=True, error_model="numpy", fastmath=True, allocates=False, overlaps=False)
def load_window(sight, width, height, column, row, window):
    """Fills ``window`` (2, s) with the grey values (zero mean) and weights of the samples around a pixel. Returns the
    sum of the weights, and the weighted sum of squares.

    Pixels outside the subject have zero weight. Pixels of another brightness than the middle have a small weight (half
    at the sight's ``contrast``), so that a window at an edge covers only one surface. ``width`` and ``height`` are the
    image size.
    """
    pairs, pattern, start = sight.pairs, sight.pattern, np.uint64(sight.start)
    x0, y0, right, lowest = np.float32(column), np.float32(row), np.float32(width - 1), np.float32(height - 1)
    zero, stride = np.float32(0.0), np.int32(width)
    centre = np.float32(np.int32(pairs[start + np.uint64(row * width + column)] & LOW))
    falloff = np.float32(1.0 / (sight.contrast * sight.contrast))
    total, mean = np.float32(0.0), np.float32(0.0)
    for i in range(pattern.shape[1]):
        x, y = min(max(x0 + pattern[0, i], zero), right), min(max(y0 + pattern[1, i], zero), lowest)
        at = start + np.uint64(np.uint32(np.int32(y) * stride + np.int32(x)))
        value = np.float32(np.int32(pairs[at] & LOW))
        w = np.float32(0.0)
        if sight.distance_px[at] < WINDOW_PX:
            off = value - centre
            w = np.float32(1.0) / (np.float32(1.0) + off * off * falloff)
        window[0, i] = value
        window[1, i] = w
        total += w
        mean += w * value
    total = max(total, np.float32(1e-6))
    mean /= total
    energy = np.float32(0.0)
    for i in range(pattern.shape[1]):
        window[0, i] -= mean
        energy += window[1, i] * window[0, i] * window[0, i]
    return total, energy


@njit(cache=True, nogil=True, error_model="numpy", fastmath=True, inline="always")
def place_window(way, z, z_x, z_y, column, row, reach, place):
    """Projects a window, on a plane of depth ``z`` (mm) at the pixel (column, row) and slopes ``z_x``, ``z_y`` (mm per
    pixel), into another view. Returns False if this view does not see the whole window.

    Fills ``place`` (8) with the pixel x, y in the other view, its derivatives by the first view's pixel, x_x, x_y, y_x,
    y_y, and its derivatives by the depth, x_z, y_z (px per mm). ``reach`` is the result of ``farthest``.
    """
    ray0, ray1, ray2 = turned(way, column, row, 1.0)
    depth = z * ray2 + way[11]
    if depth < NEAREST_MM:
        return False
    per = 1.0 / depth
    x, y = (z * ray0 + way[9]) * per, (z * ray1 + way[10]) * per
    p_x2, p_y2 = z_x * ray2 + z * way[6], z_y * ray2 + z * way[7]
    x_x, x_y = (z_x * ray0 + z * way[0] - x * p_x2) * per, (z_y * ray0 + z * way[1] - x * p_y2) * per
    y_x, y_y = (z_x * ray1 + z * way[3] - y * p_x2) * per, (z_y * ray1 + z * way[4] - y * p_y2) * per
    wide, tall = reach * (abs(x_x) + abs(x_y)), reach * (abs(y_x) + abs(y_y))
    if x - wide < 0.0 or y - tall < 0.0 or x + wide > way[WIDTH] - 1.01 or y + tall > way[HEIGHT] - 1.01:
        return False
    if x_x * y_y - x_y * y_x < MIN_AREA:
        return False
    place[0], place[1], place[2], place[3], place[4], place[5] = x, y, x_x, x_y, y_x, y_y
    place[6], place[7] = (ray0 - x * ray2) * per, (ray1 - y * ray2) * per
    return True


@njit(cache=True, nogil=True, error_model="numpy", fastmath=True, inline="always")
def distance_there(way, place, distance_px):
    """Returns the signed distance (px) to the other view's outline at the window's middle."""
    return distance_px[int(way[START]) + int(place[1] + 0.5) * int(way[WIDTH]) + int(place[0] + 0.5)]


@njit(cache=True, nogil=True, error_model="numpy", fastmath=True, inline="always")
def correlate(way, place, sight, loaded):
    """Returns the normalised cross-correlation of the loaded window with another view at ``place``, the result of
    ``place_window``."""
    pairs, pattern, noise = sight.pairs, sight.pattern, sight.noise
    window, total, energy = loaded.window, loaded.total, loaded.energy
    x, y = np.float32(place[0]), np.float32(place[1])
    x_x, x_y, y_x, y_y = np.float32(place[2]), np.float32(place[3]), np.float32(place[4]), np.float32(place[5])
    base, stride, narrow = np.uint64(np.int64(way[START])), np.uint64(np.int64(way[WIDTH])), np.int32(way[WIDTH])
    first, second, product = np.float32(0.0), np.float32(0.0), np.float32(0.0)
    for i in range(pattern.shape[1]):
        u, v = x + x_x * pattern[0, i] + x_y * pattern[1, i], y + y_x * pattern[0, i] + y_y * pattern[1, i]
        left, top = np.int32(u), np.int32(v)
        fx, fy = u - np.float32(left), v - np.float32(top)
        at = base + np.uint64(np.uint32(top * narrow + left))
        upper, lower = pairs[at], pairs[at + stride]
        a, b = np.float32(np.int32(upper & LOW)), np.float32(np.int32(upper >> HIGH))
        c, d = np.float32(np.int32(lower & LOW)), np.float32(np.int32(lower >> HIGH))
        value = bilinear(a, b, c, d, fx, fy)
        w = window[1, i] * value
        first += w
        second += w * value
        product += w * window[0, i]
    spread = max(second - first * first / total, np.float32(0.0))
    return product / np.sqrt((energy + total * noise * noise) * (spread + total * way[NOISE] * way[NOISE]))


@njit(cache=True, nogil=True, error_model="numpy", fastmath=True, inline="always")
def match(way, sight, loaded, z, z_x, z_y, reach, place):
    """Returns the correlation of the loaded window with another view, for a given plane. Returns NO_SAY if the other
    view does not see the window, and AGAINST if it shows the point outside the subject. Fills ``place`` like
    ``place_window``."""
    if not place_window(way, z, z_x, z_y, loaded.column, loaded.row, reach, place):
        return NO_SAY
    beside = distance_there(way, place, sight.distance_px)
    if beside < UNSEEN_PX:
        return NO_SAY
    if beside > BESIDE_PX:
        return AGAINST
    return correlate(way, place, sight, loaded)


@njit(cache=True, nogil=True, error_model="numpy", fastmath=True, inline="always")
def correlate_and_slide(way, place, sight, loaded, found):
    """Fills ``found`` (3) with the correlation of the loaded window, and the gradient (1 / mm) and the information (1 /
    mm^2) of the depth along the ray.

    The function fits ``shade = gain (other + slope step) + offset`` by least squares, with gain and offset eliminated.
    The variance of a sample is the residual's variance plus noise.
    """
    pairs, pattern, noise = sight.pairs, sight.pattern, sight.noise
    window, total, energy = loaded.window, loaded.total, loaded.energy
    x, y = np.float32(place[0]), np.float32(place[1])
    x_x, x_y, y_x, y_y = np.float32(place[2]), np.float32(place[3]), np.float32(place[4]), np.float32(place[5])
    x_z, y_z = np.float32(place[6]), np.float32(place[7])
    base, stride, narrow = np.uint64(np.int64(way[START])), np.uint64(np.int64(way[WIDTH])), np.int32(way[WIDTH])
    zero = np.float32(0.0)
    s_k, s_j, s_kk, s_kj, s_jj, s_kr, s_jr = zero, zero, zero, zero, zero, zero, zero
    for i in range(pattern.shape[1]):
        u, v = x + x_x * pattern[0, i] + x_y * pattern[1, i], y + y_x * pattern[0, i] + y_y * pattern[1, i]
        left, top = np.int32(u), np.int32(v)
        fx, fy = u - np.float32(left), v - np.float32(top)
        at = base + np.uint64(np.uint32(top * narrow + left))
        upper, lower = pairs[at], pairs[at + stride]
        a, b = np.float32(np.int32(upper & LOW)), np.float32(np.int32(upper >> HIGH))
        c, d = np.float32(np.int32(lower & LOW)), np.float32(np.int32(lower >> HIGH))
        value = bilinear(a, b, c, d, fx, fy)
        across, along = bilinear_slopes(a, b, c, d, fx, fy)
        slope = x_z * across + y_z * along
        wk, wj = window[1, i] * value, window[1, i] * slope
        s_k += wk
        s_j += wj
        s_kk += wk * value
        s_kj += wk * slope
        s_jj += wj * slope
        s_kr += wk * window[0, i]
        s_jr += wj * window[0, i]
    # In single precision, and with three divisions: in double they took a quarter of the time.
    per, theirs = np.float32(1.0) / total, total * np.float32(way[NOISE] * way[NOISE])
    ours = total * np.float32(noise * noise)
    kk = max(s_kk - s_k * s_k * per, zero) + theirs
    kj = s_kj - s_k * s_j * per
    jj = max(s_jj - s_j * s_j * per, zero)
    by_kk = np.float32(1.0) / kk
    gain = s_kr * by_kk
    precise = gain * total / (max(energy - gain * s_kr, zero) + ours + gain * gain * theirs)
    found[0] = s_kr / np.sqrt((energy + ours) * kk)
    found[1] = precise * (s_jr - gain * kj)
    found[2] = precise * gain * max(jj - kj * kj * by_kk, zero)


@njit(cache=True, nogil=True, error_model="numpy", fastmath=True, inline="always")
def score_best_half(scores, count):
    """Returns a cost: 1 minus the mean of the better half of the first ``count`` scores (at least two), since the other
    half may not see the point. Sorts ``scores``. A single score adds ``ALONE``; no score gives ``NOT_COMPARED``."""
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
    """Returns the matching cost (0 to 2) of the loaded window with the other views, for a given plane. The cost is 2 if
    a view shows the point outside the subject."""
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

    ``slopes`` (h, w, 4) are the slopes of near by x and y, and of far by x and y, mm per pixel. At a pixel with
    ``strides`` (h, w) of n only every n-th depth and the last are matched; other costs are interpolated linearly.
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

    The recursion is eq. (13) of Hirschmueller, Stereo processing by semiglobal matching, 2008
    (https://doi.org/10.1109/TPAMI.2007.1166). A change of one label along the path costs ``small``, a larger change
    ``large``. Paths restart at pixels that are not ``live``.
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
    """Tests, at every pixel of one colour of a chequerboard (``parity``), the planes of the neighbours ``steps`` pixels
    away (odd numbers). Each pixel keeps the cheapest of these planes and its own. Changes ``fresh``, ``depth``,
    ``slopes`` and ``cost`` (h, w) in place.

    A cost below 0 is not yet known. A plane that differs from the current plane by less than ``same_mm``, at the pixel
    and one pixel beside it, is not tested. ``fresh`` marks planes that their neighbours have not tested yet; a pixel
    with known cost tests only fresh planes. Planes taken over in this call become fresh.
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
    """Computes one least-squares step of the depth of every pixel (h, w), from all views whose windows correlate well.

    Fills ``place_mm`` (the new depth, at most ``most_px`` away in the most sensitive view), its ``information`` (mm^-2,
    for independent samples; 0 if unknown), and ``likeness``, the mean correlation.
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
