"""Holds the compiled camera model: projection from world to pixel, its derivatives, and the z-buffer. Module
``projection`` packs the rows that describe cameras.

The loops take each camera as a row of numbers. A row named ``pose`` begins with the rotation (9 numbers, row by row)
and translation (3, mm) of camera_from_world. The lens, if present, begins at entry 12: fx fy cx cy (px) and, if the
lens distorts, k1 k2 p1 p2 k3 and the largest ray radius at which the distortion is valid. The helper functions are
inlined, so they use the floating-point mode (fast or strict) of the calling loop. Only ``distorted`` always uses fast
mode; strict mode made the visual hull 10 % slower."""

import numpy as np

from rig.jit import njit

LENS = 12  # entry of a row at which the lens begins
NOWHERE = 1e9  # a pixel outside of every image
NEAREST_MM = 1.0  # nearer, or behind the camera, nothing is seen


@njit(cache=True, nogil=True, inline="always")
def turned(pose, x, y, z):
    """Rotates a direction (x, y, z) from the world frame to the camera frame."""
    return (
        pose[0] * x + pose[1] * y + pose[2] * z,
        pose[3] * x + pose[4] * y + pose[5] * z,
        pose[6] * x + pose[7] * y + pose[8] * z,
    )


@njit(cache=True, nogil=True, inline="always")
def placed(pose, x, y, z):
    """Transforms a point (x, y, z) from the world frame to the camera frame, mm."""
    a, b, c = turned(pose, x, y, z)
    return a + pose[9], b + pose[10], c + pose[11]


@njit(cache=True, nogil=True, inline="always")
def pinhole(x, y, lens):
    """Returns the pixel (column, row) of the ray (x, y, 1) in the camera's frame, without distortion."""
    return lens[0] * x + lens[2], lens[1] * y + lens[3]


@njit(cache=True, nogil=True, fastmath=True)
def distorted(x, y, lens):
    """Returns the pixel (column, row) of the ray (x, y, 1) in the camera's frame, with Brown-Conrady distortion as in
    ``rig.camera``; NOWHERE beyond the radius at which the distortion is valid."""
    r2 = x * x + y * y
    if r2 > lens[9] * lens[9]:
        return NOWHERE, NOWHERE
    radial = 1.0 + r2 * (lens[4] + r2 * (lens[5] + r2 * lens[8]))
    u = x * radial + 2.0 * lens[6] * x * y + lens[7] * (r2 + 2.0 * x * x)
    v = y * radial + lens[6] * (r2 + 2.0 * y * y) + 2.0 * lens[7] * x * y
    return lens[0] * u + lens[2], lens[1] * v + lens[3]


@njit(cache=True, nogil=True, inline="always")
def distortion_slopes(x, y, lens):
    """Returns the derivatives of ``distorted`` (px per unit of the ray): of the column by x and y, of the row by x and
    y."""
    r2 = x * x + y * y
    radial = 1.0 + r2 * (lens[4] + r2 * (lens[5] + r2 * lens[8]))
    slope = 2.0 * (lens[4] + r2 * (2.0 * lens[5] + 3.0 * r2 * lens[8]))
    cross = slope * x * y + 2.0 * lens[6] * x + 2.0 * lens[7] * y
    xx = radial + slope * x * x + 2.0 * lens[6] * y + 6.0 * lens[7] * x
    yy = radial + slope * y * y + 6.0 * lens[6] * y + 2.0 * lens[7] * x
    return lens[0] * xx, lens[0] * cross, lens[1] * cross, lens[1] * yy


@njit(cache=True, nogil=True, inline="always")
def project(camera, x, y, z):
    """Returns the pixel (column, row) of a world point (mm); NOWHERE behind the camera or beyond the valid radius of
    its lens."""
    a, b, depth = placed(camera, x, y, z)
    if depth <= NEAREST_MM:
        return NOWHERE, NOWHERE
    return distorted(a / depth, b / depth, camera[LENS:])


@njit(cache=True, nogil=True, inline="always")
def projection_slopes(camera, x, y, z):
    """Returns the derivatives of ``project`` by the world point (px per mm): three for the column, and three for the
    row."""
    a, b, depth = placed(camera, x, y, z)
    per = 1.0 / depth
    a, b = a * per, b * per
    xx, xy, yx, yy = distortion_slopes(a, b, camera[LENS:])
    xx, xy, yx, yy = xx * per, xy * per, yx * per, yy * per
    dx0, dx1, dx2 = camera[0] - a * camera[6], camera[1] - a * camera[7], camera[2] - a * camera[8]
    dy0, dy1, dy2 = camera[3] - b * camera[6], camera[4] - b * camera[7], camera[5] - b * camera[8]
    return (
        (xx * dx0 + xy * dy0, xx * dx1 + xy * dy1, xx * dx2 + xy * dy2),
        (yx * dx0 + yy * dy0, yx * dx1 + yy * dy1, yx * dx2 + yy * dy2),
    )


@njit(cache=True, nogil=True)
def project_all(camera: np.ndarray, points: np.ndarray) -> np.ndarray:
    """Returns the pixels (n, 2) of world points (n, 3; mm); NaN where ``project`` returns NOWHERE."""
    pixels = np.empty((len(points), 2))
    for n in range(len(points)):
        column, row = project(camera, points[n, 0], points[n, 1], points[n, 2])
        seen = column < NOWHERE
        pixels[n, 0], pixels[n, 1] = column if seen else np.nan, row if seen else np.nan
    return pixels


@njit(cache=True, nogil=True, error_model="numpy")
def rasterise(
    pixels: np.ndarray, depths: np.ndarray, faces: np.ndarray, height: int, width: int
) -> tuple[np.ndarray, np.ndarray]:
    """Draws a mesh and returns, for every pixel centre, the depth (height, width; float32, camera z in mm, inf beside
    the mesh) and the visible face's index (int32, -1 beside the mesh).

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
    """Interpolates vertex values (v, c) at every pixel of a mesh that ``rasterise`` drew, perspective-correct. Returns
    (height, width, c) float32; NaN at pixels where ``seen`` holds no face."""
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
