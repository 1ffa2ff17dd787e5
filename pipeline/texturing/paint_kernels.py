"""Contains the compiled loops of ``pipeline.texturing.paint`` and ``pipeline.texturing.neighbourhood``."""

from typing import NamedTuple

import numpy as np

from rig.jit import njit

LANES = 4  # channels side by side, so that a vertex is one vector register: 16 bytes
PHASES = 64  # places between two pixels that the sampling window is tabulated for: 0.4 code of a black to white edge
TAPS = 4


class Pictures(NamedTuple):
    """Holds the photographs, cropped to the head, in one array, and the pixel of each vertex in each photograph."""

    codes: np.ndarray  # uint8 (n,), rows of pixels of three channels
    first: np.ndarray  # int64 (k,): where each begins
    width: np.ndarray  # int64 (k,)
    height: np.ndarray  # int64 (k,)
    places: np.ndarray  # float32 (k, v, 2): pixels in that part
    window: np.ndarray  # float32 (PHASES + 1, TAPS)


class Choice(NamedTuple):
    """Holds, for every vertex, the views that colour it, their weights and colour corrections (sRGB codes)."""

    slots: np.ndarray  # int32 (v, s), -1: no view
    shares: np.ndarray  # float32 (v, s)
    corrections: np.ndarray  # float32 (v, s, 4)
    colours: np.ndarray  # float32 (v, 4): codes where no view can be asked
    weights: np.ndarray  # float32 (k, v), 0 where a view does not see a vertex


@njit(cache=True, nogil=True, inline="always")
def sample(pictures: Pictures, k: int, x: float, y: float, out: np.ndarray) -> None:
    """Reads the sRGB codes at the pixel (x, y) of view k into ``out`` (3), with a window of 4 x 4 pixels. A point
    outside the picture gets the codes of the border."""
    width, height = pictures.width[k], pictures.height[k]
    x = min(max(x, 0.0), width - 1.0)
    y = min(max(y, 0.0), height - 1.0)
    left, top = int(x), int(y)
    across, down = int((x - left) * PHASES + 0.5), int((y - top) * PHASES + 0.5)
    r, g, b = np.float32(0.0), np.float32(0.0), np.float32(0.0)
    inner = left >= 1 and top >= 1 and left + 2 < width and top + 2 < height
    codes, window = pictures.codes, pictures.window
    for j in range(TAPS):
        row = top + j - 1
        if not inner:
            row = min(max(row, 0), height - 1)
        start = pictures.first[k] + 3 * (row * width + left - 1)
        rr, gg, bb = np.float32(0.0), np.float32(0.0), np.float32(0.0)
        for i in range(TAPS):
            at = start + 3 * i
            if not inner:
                at = pictures.first[k] + 3 * (row * width + min(max(left + i - 1, 0), width - 1))
            share = window[across, i]
            rr += share * codes[at]
            gg += share * codes[at + 1]
            bb += share * codes[at + 2]
        share = window[down, j]
        r += share * rr
        g += share * gg
        b += share * bb
    out[0], out[1], out[2] = r, g, b


@njit(cache=True, nogil=True)
def gather(
    corners: tuple[int, int, int], choice: Choice, view: np.ndarray, share: np.ndarray, added: np.ndarray
) -> int:  # fmt: skip
    """Collects the views that colour a triangle: those that see all three corners and were chosen at one. Returns the
    number n of these views.

    Fills ``view`` (n), ``share`` (n, 3), the weight of each view at each corner, and ``added`` (3, 3), the correction
    (codes, RGB) at each corner.
    """
    slots, weights = choice.slots, choice.weights
    n = 0
    for c in range(3):
        for s in range(slots.shape[1]):
            k = slots[corners[c], s]
            if k < 0 or not (weights[k, corners[0]] > 0 and weights[k, corners[1]] > 0 and weights[k, corners[2]] > 0):
                continue
            at = 0
            while at < n and view[at] != k:
                at += 1
            if at == n:
                view[n] = k
                share[n] = 0.0
                n += 1
            share[at, c] = choice.shares[corners[c], s]
    added[:] = 0.0
    for c in range(3):
        total = np.float32(0.0)
        for at in range(n):
            total += share[at, c]
        if total <= 0.0:  # the others' views are asked here, too
            for at in range(n):
                share[at, c] = share[at, (c + 1) % 3] + share[at, (c + 2) % 3]
                total += share[at, c]
        for at in range(n):
            share[at, c] /= total
            if share[at, c] > 0.0:
                for channel in range(3):
                    added[c, channel] += share[at, c] * correction_of(corners, c, view[at], channel, choice)
    return n


@njit(cache=True, nogil=True, inline="always")
def correction_of(corners: tuple[int, int, int], c: int, k: int, channel: int, choice: Choice) -> np.floating:
    """Returns the colour correction of view k at corner c, or at the first other corner if corner c does not use the
    view."""
    for turn in range(3):
        v = corners[(c + turn) % 3]
        for s in range(choice.slots.shape[1]):
            if choice.slots[v, s] == k:
                return choice.corrections[v, s, channel]
    return np.float32(0.0)


@njit(cache=True, nogil=True)
def paint_rows(
    image: np.ndarray, row: int, rows: int, which: np.ndarray, texels: np.ndarray, faces: np.ndarray,
    source: np.ndarray, pictures: Pictures, choice: Choice,
) -> None:  # fmt: skip
    """Paints the triangles ``which`` of a UV layout into ``image`` (h, w, 3; BGR), in place. The function changes
    ``rows`` image rows, the first of which is ``row``.

    ``texels`` (n, 2) are the corners' positions in the image, ``faces`` (f, 3) the layout's triangles, and ``source``
    (n) the head's vertex for each corner.
    """
    width = image.shape[1]
    code = np.zeros(3, np.float32)
    most = 3 * choice.slots.shape[1]
    view, share, added = np.zeros(most, np.int32), np.zeros((most, 3), np.float32), np.zeros((3, 3), np.float32)
    for n in range(len(which)):
        f = which[n]
        i, j, k = faces[f, 0], faces[f, 1], faces[f, 2]
        ax, ay, bx, by, cx, cy = texels[i, 0], texels[i, 1], texels[j, 0], texels[j, 1], texels[k, 0], texels[k, 1]
        area = (bx - ax) * (cy - ay) - (by - ay) * (cx - ax)
        if not abs(area) > 1e-12:
            continue
        low, high = max(np.ceil(min(ay, by, cy)), float(row)), min(np.floor(max(ay, by, cy)), row + rows - 1.0)
        left, right = max(np.ceil(min(ax, bx, cx)), 0.0), min(np.floor(max(ax, bx, cx)), width - 1.0)
        if low > high or left > right:
            continue
        p, q, s = source[i], source[j], source[k]
        found = gather((p, q, s), choice, view, share, added)
        if found == 0:
            added[0], added[1], added[2] = choice.colours[p, :3], choice.colours[q, :3], choice.colours[s, :3]
        for y in range(int(low), int(high) + 1):
            for x in range(int(left), int(right) + 1):
                wa = ((bx - x) * (cy - y) - (by - y) * (cx - x)) / area
                wb = ((cx - x) * (ay - y) - (cy - y) * (ax - x)) / area
                wc = 1.0 - wa - wb
                if wa < -1e-9 or wb < -1e-9 or wc < -1e-9:
                    continue
                a, b, c = np.float32(wa), np.float32(wb), np.float32(wc)
                red = a * added[0, 0] + b * added[1, 0] + c * added[2, 0]
                green = a * added[0, 1] + b * added[1, 1] + c * added[2, 1]
                blue = a * added[0, 2] + b * added[1, 2] + c * added[2, 2]
                for at in range(found):
                    part = a * share[at, 0] + b * share[at, 1] + c * share[at, 2]
                    if part <= 0.0:
                        continue
                    place = pictures.places[view[at]]
                    sample(
                        pictures,
                        view[at],
                        a * place[p, 0] + b * place[q, 0] + c * place[s, 0],
                        a * place[p, 1] + b * place[q, 1] + c * place[s, 1],
                        code,
                    )
                    red += part * code[0]
                    green += part * code[1]
                    blue += part * code[2]
                image[y, x, 0] = np.uint8(min(max(blue + np.float32(0.5), np.float32(0.0)), np.float32(255.0)))
                image[y, x, 1] = np.uint8(min(max(green + np.float32(0.5), np.float32(0.0)), np.float32(255.0)))
                image[y, x, 2] = np.uint8(min(max(red + np.float32(0.5), np.float32(0.0)), np.float32(255.0)))


@njit(cache=True)
def by_rings(starts: np.ndarray, indices: np.ndarray, known: np.ndarray) -> np.ndarray:
    """Returns the unknown vertices in the order in which a flood from the known vertices reaches them. Vertices that
    the flood does not reach are left out."""
    met = known.copy()
    queue = np.empty(len(known), np.int32)
    tail = 0
    for v in range(len(known)):
        if known[v]:
            for k in range(starts[v], starts[v + 1]):
                if not met[indices[k]]:
                    met[indices[k]] = True
                    queue[tail] = indices[k]
                    tail += 1
    head = 0
    while head < tail:
        v = queue[head]
        head += 1
        for k in range(starts[v], starts[v + 1]):
            if not met[indices[k]]:
                met[indices[k]] = True
                queue[tail] = indices[k]
                tail += 1
    return queue[:tail].copy()


@njit(cache=True)
def first_guess(
    values: np.ndarray, starts: np.ndarray, indices: np.ndarray, order: np.ndarray, known: np.ndarray
) -> None:
    """Sets each vertex, in the given ``order``, to the mean of its neighbours that are already known. Changes
    ``values`` (v, LANES) and ``known`` (v) in place."""
    for v in order:
        total, count = np.zeros(LANES, np.float32), 0
        for k in range(starts[v], starts[v + 1]):
            if known[indices[k]]:
                total += values[indices[k]]
                count += 1
        values[v] = total / np.float32(max(count, 1))
        known[v] = True


@njit(cache=True, error_model="numpy")
def relax(
    values: np.ndarray, starts: np.ndarray, indices: np.ndarray, order: np.ndarray, sweeps: int, factor: float
) -> None:
    """Moves the values of the vertices ``order`` towards the mean of their neighbours by successive over-relaxation
    with ``factor``. Sweeps alternate in direction. Changes ``values`` (v, LANES) in place."""
    for sweep in range(sweeps):
        for step in range(len(order)):
            v = order[step] if sweep % 2 == 0 else order[len(order) - 1 - step]
            a, b, c, d = np.float32(0.0), np.float32(0.0), np.float32(0.0), np.float32(0.0)
            for k in range(starts[v], starts[v + 1]):
                at = indices[k]
                a += values[at, 0]
                b += values[at, 1]
                c += values[at, 2]
                d += values[at, 3]
            share, kept = np.float32(factor / (starts[v + 1] - starts[v])), np.float32(1.0 - factor)
            values[v, 0] = kept * values[v, 0] + share * a
            values[v, 1] = kept * values[v, 1] + share * b
            values[v, 2] = kept * values[v, 2] + share * c
            values[v, 3] = kept * values[v, 3] + share * d
