"""Compiled loops of ``pipeline.geometry.raster``."""

import numpy as np

from rig.jit import njit


@njit(cache=True, nogil=True, error_model="numpy")
def rasterise(
    pixels: np.ndarray, depths: np.ndarray, faces: np.ndarray, height: int, width: int
) -> tuple[np.ndarray, np.ndarray]:
    """Draws a mesh and returns what is seen at every pixel centre: depth (height, width; float32, camera z in mm, inf
    where there is nothing) and face index (int32, -1 for none).

    ``pixels`` (v, 2) and ``depths`` (v) are the projected vertices, float64. A triangle with a vertex that is not
    finite or not in front of the camera is left out. Depth is perspective-correct: 1/z is linear in the image.
    """
    depth = np.full((height, width), np.inf, np.float32)
    seen = np.full((height, width), -1, np.int32)
    for f in range(faces.shape[0]):
        a, b, c = np.uint32(faces[f, 0]), np.uint32(faces[f, 1]), np.uint32(faces[f, 2])
        za, zb, zc = depths[a], depths[b], depths[c]
        ax, ay, bx, by, cx, cy = pixels[a, 0], pixels[a, 1], pixels[b, 0], pixels[b, 1], pixels[c, 0], pixels[c, 1]
        area = (bx - ax) * (cy - ay) - (by - ay) * (cx - ax)
        x_low, x_high = max(np.ceil(min(ax, bx, cx)), 0.0), min(np.floor(max(ax, bx, cx)), width - 1.0)
        y_low, y_high = max(np.ceil(min(ay, by, cy)), 0.0), min(np.floor(max(ay, by, cy)), height - 1.0)
        drawn = (za > 0.0) & (zb > 0.0) & (zc > 0.0) & (abs(area) > 1e-12)  # NaN ends here too
        if not (drawn & (x_low <= x_high) & (y_low <= y_high)):
            continue
        ia, ib, ic, share = 1.0 / za, 1.0 / zb, 1.0 / zc, 1.0 / area
        for y in range(int(y_low), int(y_high) + 1):
            a_y, b_y, c_y = (ay - y) * share, (by - y) * share, (cy - y) * share
            for x in range(int(x_low), int(x_high) + 1):  # without branches: half of the pixels lie outside
                wa, wb = (bx - x) * c_y - (cx - x) * b_y, (cx - x) * a_y - (ax - x) * c_y
                wc = 1.0 - wa - wb
                z, before = np.float32(1.0 / (wa * ia + wb * ib + wc * ic)), depth[y, x]
                nearer = (min(wa, wb, wc) >= 0.0) & (z < before)
                depth[y, x] = z if nearer else before
                seen[y, x] = f if nearer else seen[y, x]
    return depth, seen


@njit(cache=True, nogil=True)
def interpolate(
    seen: np.ndarray, pixels: np.ndarray, depths: np.ndarray, faces: np.ndarray, values: np.ndarray
) -> np.ndarray:
    """Interpolates values of the vertices (v, c) at every pixel of a mesh that ``rasterise`` drew, perspective-correct.
    Returns (height, width, c) float32; NaN where no face is ``seen``."""
    height, width = seen.shape
    out = np.full((height, width, values.shape[1]), np.nan, np.float32)
    for y in range(height):
        for x in range(width):
            f = seen[y, x]
            if f < 0:
                continue
            a, b, c = faces[f, 0], faces[f, 1], faces[f, 2]
            ax, ay, bx, by, cx, cy = pixels[a, 0], pixels[a, 1], pixels[b, 0], pixels[b, 1], pixels[c, 0], pixels[c, 1]
            # twice the areas of the parts over depth: the triangle's own area cancels
            wa = ((bx - x) * (cy - y) - (by - y) * (cx - x)) / depths[a]
            wb = ((cx - x) * (ay - y) - (cy - y) * (ax - x)) / depths[b]
            wc = ((ax - x) * (by - y) - (ay - y) * (bx - x)) / depths[c]
            total = wa + wb + wc
            for k in range(values.shape[1]):
                out[y, x, k] = (wa * values[a, k] + wb * values[b, k] + wc * values[c, k]) / total
    return out
