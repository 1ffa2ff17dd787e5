"""Compiled loops of ``pipeline.texture.paint``."""

from typing import NamedTuple

import numpy as np

from pipeline.compiled import njit

PHASES = 64  # places between two pixels that the sampling window is tabulated for: 0.4 code of a black to white edge
TAPS = 4


class Pictures(NamedTuple):
    """The photographs' parts that show the head, one behind the other, and where the vertices lie in them."""

    codes: np.ndarray  # uint8 (n,), rows of pixels of three channels
    first: np.ndarray  # int64 (k,): where each begins
    width: np.ndarray  # int64 (k,)
    height: np.ndarray  # int64 (k,)
    places: np.ndarray  # float32 (k, v, 2): pixels in that part
    window: np.ndarray  # float32 (PHASES + 1, TAPS)


class Choice(NamedTuple):
    """What every vertex takes: a view, and what its colour is raised by, in codes."""

    labels: np.ndarray  # int32 (v,), -1: no view
    correction: np.ndarray  # float32 (v, 4)
    colours: np.ndarray  # float32 (v, 4): codes where no view can be asked
    weights: np.ndarray  # float32 (k, v), 0 where a view does not see a vertex


@njit(cache=True, nogil=True, inline="always")
def sample(pictures: Pictures, k: int, x: float, y: float, out: np.ndarray) -> None:
    """Codes about (x, y) in view k, in the window; its border pixels go on outside."""
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
def face_views(labels: np.ndarray, weights: np.ndarray, faces: np.ndarray) -> np.ndarray:
    """Which corner's view, and correction, each corner of each face takes: its own where that view sees all of the
    face, else another corner's that does, else none (-1)."""
    out = np.full((len(faces), 3), -1, np.int32)
    for f in range(len(faces)):
        good = -1
        for turn in range(3):
            k = labels[faces[f, turn]]
            if k >= 0 and weights[k, faces[f, 0]] > 0 and weights[k, faces[f, 1]] > 0 and weights[k, faces[f, 2]] > 0:
                out[f, turn] = turn
                if good < 0:
                    good = turn
        for turn in range(3):
            if out[f, turn] < 0:
                out[f, turn] = good
    return out


@njit(cache=True, nogil=True)
def paint_rows(
    image: np.ndarray,
    row: int,
    rows: int,
    which: np.ndarray,
    texels: np.ndarray,
    faces: np.ndarray,
    source: np.ndarray,
    views: np.ndarray,
    pictures: Pictures,
    choice: Choice,
) -> None:
    """Paints what the faces ``which`` cover of ``rows`` rows from ``row`` on. Blue first, as encoders want it."""
    width = image.shape[1]
    code = np.zeros(3, np.float32)
    for n in range(len(which)):
        f = which[n]
        i, j, k = faces[f, 0], faces[f, 1], faces[f, 2]
        ax, ay, bx, by, cx, cy = texels[i, 0], texels[i, 1], texels[j, 0], texels[j, 1], texels[k, 0], texels[k, 1]
        area = (bx - ax) * (cy - ay) - (by - ay) * (cx - ax)
        if not abs(area) > 1e-12:
            continue
        low, high = max(np.ceil(min(ay, by, cy)), float(row)), min(np.floor(max(ay, by, cy)), row + rows - 1.0)
        left, right = max(np.ceil(min(ax, bx, cx)), 0.0), min(np.floor(max(ax, bx, cx)), width - 1.0)
        p, q, s = source[i], source[j], source[k]
        corners = (p, q, s)
        own = views[f, 0] >= 0
        first = choice.labels[corners[views[f, 0]]] if own else -1
        second = choice.labels[corners[views[f, 1]]] if own else -1
        third = choice.labels[corners[views[f, 2]]] if own else -1
        alike = own and first == second and second == third
        for y in range(int(low), int(high) + 1):
            for x in range(int(left), int(right) + 1):
                wa = ((bx - x) * (cy - y) - (by - y) * (cx - x)) / area
                wb = ((cx - x) * (ay - y) - (cy - y) * (ax - x)) / area
                wc = 1.0 - wa - wb
                if wa < -1e-9 or wb < -1e-9 or wc < -1e-9:
                    continue
                r, g, b = np.float32(0.0), np.float32(0.0), np.float32(0.0)
                for corner in range(3):
                    share = np.float32(wa if corner == 0 else wb if corner == 1 else wc)
                    if not own:
                        v = corners[corner]
                        r += share * choice.colours[v, 0]
                        g += share * choice.colours[v, 1]
                        b += share * choice.colours[v, 2]
                        continue
                    v = corners[views[f, corner]]
                    if corner == 0 or not alike:
                        at = pictures.places[choice.labels[v]]
                        sample(
                            pictures,
                            choice.labels[v],
                            wa * at[p, 0] + wb * at[q, 0] + wc * at[s, 0],
                            wa * at[p, 1] + wb * at[q, 1] + wc * at[s, 1],
                            code,
                        )
                    r += share * (code[0] + choice.correction[v, 0])
                    g += share * (code[1] + choice.correction[v, 1])
                    b += share * (code[2] + choice.correction[v, 2])
                image[y, x, 0] = np.uint8(min(max(b + np.float32(0.5), np.float32(0.0)), np.float32(255.0)))
                image[y, x, 1] = np.uint8(min(max(g + np.float32(0.5), np.float32(0.0)), np.float32(255.0)))
                image[y, x, 2] = np.uint8(min(max(r + np.float32(0.5), np.float32(0.0)), np.float32(255.0)))
