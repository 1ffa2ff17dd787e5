"""Contains the compiled loops of ``vertex_colours``, ``neighbourhood`` and ``visibility``."""

import numpy as np

from rig.jit import njit

WINDOW = 2  # pixels around a vertex in which a nearer surface may blur over it: 3 sigma of the preset's defocus
SLOPE_SLACK = 1.5  # by how much more than its own slope a surface may come nearer within the window
POOR = 1e-4  # weight of a view that has nothing but excuses, by that of a good one
OUTLIER = 0.12  # difference from the median of the views, by its level, at which a brighter view counts half
DARKER = 0.5  # of a difference, where a view is darker: most are shading that turns with the surface, few are shadows
MAX_VOTE = 0.7  # of a view about the median, by the mean weight: a close-up that a shadow lies in is one of many
MIN_SHARE = 0.005  # of a vertex's weight: a view with less has not coloured it
NEVER = np.float32(1e6)  # cost of a view that does not see a vertex
RING_SHARE = 0.7  # of a view's quality that the neighbours decide: beside an occluding edge it soon sees something else


@njit(cache=True, nogil=True)
def ring_quality(weights: np.ndarray, starts: np.ndarray, indices: np.ndarray) -> np.ndarray:
    """Returns the quality (v, k) of each view at each vertex. The quality mixes the vertex's weight with the smallest
    weight of its neighbours, which is small near occlusions. ``weights`` is (k, v)."""
    cameras, count = weights.shape
    out = np.zeros((count, cameras), np.float32)
    for v in range(count):
        for k in range(cameras):
            weight = weights[k, v]
            if weight <= 0:
                continue
            least = weight
            for e in range(starts[v], starts[v + 1]):
                least = min(least, weights[k, indices[e]])
            out[v, k] = weight * (1 - RING_SHARE) + least * RING_SHARE
    return out


@njit(cache=True, nogil=True)
def best_candidates(costs: np.ndarray, most: int) -> tuple[np.ndarray, np.ndarray]:
    """Returns the ``most`` views of lowest cost (v, most) for each vertex, the lowest first, and their costs. Missing
    views are -1. ``costs`` is (v, k)."""
    count, cameras = costs.shape
    views = np.full((count, most), -1, np.int32)
    found = np.full((count, most), NEVER, np.float32)
    for v in range(count):
        for k in range(cameras):
            cost = costs[v, k]
            if cost >= NEVER or cost >= found[v, most - 1]:
                continue
            place = most - 1
            while place > 0 and found[v, place - 1] > cost:
                found[v, place], views[v, place] = found[v, place - 1], views[v, place - 1]
                place -= 1
            found[v, place], views[v, place] = cost, k
    return views, found


@njit(cache=True, nogil=True)
def propagate(
    views: np.ndarray,
    costs: np.ndarray,
    starts: np.ndarray,
    indices: np.ndarray,
    opposite: np.ndarray,
    penalty: np.ndarray,
    cameras: int,
    sweeps: int,
) -> np.ndarray:
    """Labels each vertex with a view by min-sum belief propagation with a Potts term. Returns the label's position
    among the vertex's candidate views; -1 without candidates.

    ``views`` and ``costs`` (v, candidates) are the results of ``best_candidates``. ``penalty`` (e) is the cost of
    different views at both ends of a directed edge. ``starts``, ``indices`` and ``opposite`` come from
    ``Neighbourhood``. A message along an edge is stored for the candidate views of the receiving vertex, relative to
    the message for any other label.
    """
    count, most = views.shape
    messages = np.zeros((len(indices), most), np.float32)  # of edge e = (v, w): what w tells v
    belief, by_view = np.zeros(most, np.float32), np.full(cameras, NEVER, np.float32)
    for sweep in range(sweeps):
        for step in range(count):
            v = step if sweep % 2 == 0 else count - 1 - step
            for c in range(most):
                belief[c] = costs[v, c]
                for e in range(starts[v], starts[v + 1]):
                    belief[c] += messages[e, c]
            for e in range(starts[v], starts[v + 1]):
                least = NEVER
                for c in range(most):
                    if views[v, c] >= 0:
                        cost = belief[c] - messages[e, c]
                        by_view[views[v, c]] = cost
                        least = min(least, cost)
                back, receiver = opposite[e], indices[e]
                limit = least + penalty[e]
                for c in range(most):
                    label = views[receiver, c]
                    cost = by_view[label] if label >= 0 else NEVER
                    messages[back, c] = min(cost, limit) - limit
            for c in range(most):
                if views[v, c] >= 0:
                    by_view[views[v, c]] = NEVER
    chosen = np.full(count, -1, np.int32)
    for v in range(count):
        least = NEVER
        for c in range(most):
            if views[v, c] >= 0:
                total = costs[v, c]
                for e in range(starts[v], starts[v + 1]):
                    total += messages[e, c]
                if chosen[v] < 0 or total < least:
                    least, chosen[v] = total, c
    return chosen


@njit(cache=True, nogil=True)
def level_view(
    aims: np.ndarray,
    seen: np.ndarray,
    starts: np.ndarray,
    indices: np.ndarray,
    strength: float,
    sweeps: int,
    factor: float,
) -> None:
    """Computes the smooth colour correction c of one view, and writes it into ``aims`` (v, 4; codes). The correction
    minimises ``|c_v - aim_v|^2 + strength |c_v - c_w|^2``, summed over the ``seen`` vertices v and their edges (v, w),
    by successive over-relaxation."""
    rows = np.flatnonzero(seen)
    fixed = aims.copy()
    s, kept = np.float32(strength), np.float32(1.0 - factor)
    for _ in range(sweeps):  # always forwards: there and back, over-relaxing gains nothing
        for turn in range(len(rows)):
            v = rows[turn]
            a, b, c, total = fixed[v, 0], fixed[v, 1], fixed[v, 2], np.float32(1.0)
            for e in range(starts[v], starts[v + 1]):
                w = indices[e]
                if seen[w]:
                    a += s * aims[w, 0]
                    b += s * aims[w, 1]
                    c += s * aims[w, 2]
                    total += s
            move = np.float32(factor) / total
            aims[v, 0] = kept * aims[v, 0] + move * a
            aims[v, 1] = kept * aims[v, 1] + move * b
            aims[v, 2] = kept * aims[v, 2] + move * c


@njit(cache=True, nogil=True)
def differences(
    labels: np.ndarray, views: np.ndarray, detail: np.ndarray, weights: np.ndarray, starts: np.ndarray,
    indices: np.ndarray,
) -> np.ndarray:  # fmt: skip
    """Returns the mean squared difference of ``detail`` (k, v, 3; codes) between each candidate view (v, candidates)
    and the chosen view. The mean is over the vertex and its neighbours that both views see; -1 if there are none."""
    count, most = views.shape
    out = np.full((count, most), np.float32(-1.0), np.float32)
    for v in range(count):
        chosen = labels[v]
        if chosen < 0:
            continue
        for c in range(most):
            k = views[v, c]
            if k < 0:
                continue
            total, n = np.float32(0.0), 0
            for e in range(starts[v] - 1, starts[v + 1]):
                w = v if e < starts[v] else indices[e]
                if weights[k, w] > 0 and weights[chosen, w] > 0:
                    for channel in range(3):
                        off = detail[k, w, channel] - detail[chosen, w, channel]
                        total += off * off
                    n += 3
            out[v, c] = total / max(n, 1)
    return out


@njit(cache=True, nogil=True)
def fill_slots(
    labels: np.ndarray, views: np.ndarray, shares: np.ndarray, slots: int
) -> tuple[np.ndarray, np.ndarray]:  # fmt: skip
    """Returns the chosen view of each vertex and the views with the next largest shares (v, slots; -1: none). The
    function also returns the views' shares, scaled to sum 1."""
    count, most = views.shape
    found = np.full((count, slots), -1, np.int32)
    weight = np.zeros((count, slots), np.float32)
    for v in range(count):
        if labels[v] < 0:
            continue
        found[v, 0], weight[v, 0] = labels[v], 1.0
        for c in range(most):
            share = shares[v, c]
            if views[v, c] < 0 or views[v, c] == labels[v] or share <= weight[v, slots - 1] or share < 0.05:
                continue
            place = slots - 1
            while place > 1 and weight[v, place - 1] < share:
                found[v, place], weight[v, place] = found[v, place - 1], weight[v, place - 1]
                place -= 1
            found[v, place], weight[v, place] = views[v, c], share
        total = np.float32(0.0)
        for c in range(slots):
            total += weight[v, c]
        for c in range(slots):
            weight[v, c] /= total
    return found, weight


@njit(cache=True, nogil=True)
def blend_views(weights: np.ndarray, colours: np.ndarray, outlier: float) -> tuple[np.ndarray, np.ndarray]:
    """Returns the mean colour (v, 3) of each vertex over the views, weighted by ``weights`` (k, v), and the number of
    views that contribute. Views that differ from the weighted median of a channel count less. ``colours`` (k, v, 3) are
    linear.

    ``outlier`` is the difference from the median, relative to the median, at which a brighter view (a highlight) counts
    half. A darker view, which may show a shadow, counts half at twice this difference.
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


@njit(cache=True, nogil=True, inline="always")
def nearest_sample(depth: np.ndarray, row: int, column: int, reach: int) -> float:
    """Returns the smallest depth (mm) in a square window that extends ``reach`` pixels around a pixel."""
    nearest = np.inf
    for j in range(max(0, row - reach), min(depth.shape[0], row + reach + 1)):
        for i in range(max(0, column - reach), min(depth.shape[1], column + reach + 1)):
            nearest = min(nearest, depth[j, i])
    return nearest


@njit(cache=True, nogil=True)
def visibility_weights(
    pixels: np.ndarray,
    depths: np.ndarray,
    facing: np.ndarray,
    depth: np.ndarray,
    distance: np.ndarray,
    pixel_angle: float,
    limits: tuple[float, float, float, float],
) -> np.ndarray:
    """Returns the weight (float32) with which one camera sees each point (v); 0 for a point that it does not see.

    A point counts if it lies inside the silhouette by a margin, and no nearer surface of the depth map hides it. A
    point's weight is cosine^sharpness / depth^2, reduced towards the margin, and ``POOR`` times that at a flat angle or
    beside an occluding edge.

    Args:
        pixels: of the points (v, 2).
        depths: of the points along the camera's z axis, mm.
        facing: cosine between normal and line of sight.
        depth: the surface's depth map, mm.
        distance: signed distance to the silhouette, px.
        pixel_angle: width of a pixel at a depth of 1.
        limits: margin to the silhouette (px), depth by which a nearer surface hides a point (mm), smallest cosine of a
            good view, and the exponent of the cosine.
    """
    margin, hidden, least, sharpness = limits
    height, width = depth.shape
    weights = np.zeros(len(depths), np.float32)
    for v in range(len(depths)):
        x, y, cosine = pixels[v, 0], pixels[v, 1], facing[v]
        if not (x >= 1 and y >= 1 and x < width - 2 and y < height - 2 and cosine > 0.02):  # NaN is not seen either
            continue
        column, row = int(x + 0.5), int(y + 0.5)
        clear = -distance[row, column] - margin
        if clear <= 0:
            continue
        slope = np.sqrt(1 - min(1.0, cosine * cosine)) / cosine
        step = pixel_angle * depths[v] * min(slope, 4.0)  # how much nearer its own surface comes within a pixel
        # Its own pixel shows it at the pixel's centre; the next ones are in its sample.
        if depths[v] > depth[row, column] + hidden + 0.5 * step:
            continue
        if depths[v] > nearest_sample(depth, row, column, 1) + hidden + SLOPE_SLACK * 2.1 * step:
            continue
        around = nearest_sample(depth, row, column, WINDOW)
        good = cosine > least and depths[v] <= around + hidden + SLOPE_SLACK * 1.414 * WINDOW * step
        # A ramp from the margin inwards, so that a camera's share begins at nothing and leaves no seam.
        ramp = min(1.0, clear / (2 * margin + 1.0))
        weights[v] = (1.0 if good else POOR) * cosine**sharpness * ramp / (depths[v] * depths[v]) * 1e6
    return weights


@njit(cache=True, nogil=True)
def sample_colours(
    image: np.ndarray, pixels: np.ndarray, weights: np.ndarray, table: np.ndarray, sigma: float
) -> np.ndarray:
    """Returns the linear colours (v, 3) of the points with a weight, from a Gaussian window of 4 x 4 pixels around each
    projection, which has less noise than a single sample.

    The window averages sRGB codes, whose noise is the same at all levels; in linear light a bright pixel would dominate
    a dark crease. ``table`` is the linear light of each code, ``sigma`` the window's width in px.
    """
    height, width = image.shape[:2]
    out, across, down = np.zeros((len(weights), 3), np.float32), np.empty(4), np.empty(4)
    scale = -0.5 / (sigma * sigma)
    for v in range(len(weights)):
        if weights[v] <= 0:
            continue
        x, y = pixels[v, 0], pixels[v, 1]
        left, top = int(np.floor(x)) - 1, int(np.floor(y)) - 1
        total, r, g, b = 0.0, 0.0, 0.0, 0.0
        for k in range(4):
            across[k], down[k] = np.exp(scale * (left + k - x) ** 2), np.exp(scale * (top + k - y) ** 2)
        for j in range(max(0, top), min(height, top + 4)):
            for i in range(max(0, left), min(width, left + 4)):
                share = across[i - left] * down[j - top]
                total += share
                r += share * image[j, i, 0]
                g += share * image[j, i, 1]
                b += share * image[j, i, 2]
        for c, code in enumerate((r / total, g / total, b / total)):
            low = min(int(code), 254)
            out[v, c] = table[low] + (code - low) * (table[low + 1] - table[low])
    return out
