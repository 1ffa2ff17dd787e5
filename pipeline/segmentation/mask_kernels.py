"""Contains the compiled loops of ``foreground``, ``segment`` and ``matting``."""

import numpy as np

from pipeline.geometry.projection_kernels import LENS, NEAREST_MM, distorted, placed
from pipeline.imaging.sampling_kernels import bilinear
from rig.jit import njit

OTHER = 10.0  # log odds that a pixel must show against every mixture before it is taken for another colour
# q by alpha, at most: two standard deviations of the subject's brightness. What is brighter at the rim is a highlight:
# white light passed for grey wall (a negative alpha), and 14 % of an oily head's outline lay more than
# 1 px inside the true one; 4 % do now.
BRIGHTEST = 1.16
MAX_ALPHA_INFORMATION = 25.0  # 1 / variance of one pixel's alpha, below which it is averaged in a wider window
MAX_DISSENT = 3  # more dissent than this is not counted
MIN_WITNESSES = 4  # cameras that must see a point before it can be allowed
STEPS = 96  # points on a ray: 4 mm on a subject of 400 mm
SLACK = 1.0  # mask pixels by which a point may miss a mask
MAX_ODDS = 6.0  # log odds are clipped there, so that one pixel cannot outvote its eight neighbours for ever


@njit(cache=True, nogil=True)
def mean_field_sweeps(odds: np.ndarray, residual: np.ndarray, strength: float, sweeps: int) -> np.ndarray:
    """Returns half the log odds (h, w) of each pixel after mean-field sweeps over its eight neighbours, by Gauss-Seidel
    in alternating order.

    ``odds`` (h, w) are the log odds of each pixel alone. Two neighbours are coupled by strength exp(-|difference|^2 /
    18), where the difference is between their ``residual`` (h, w, c; standard deviations). Diagonal neighbours are
    coupled 0.71 times as strongly.
    """
    height, width = odds.shape
    steps = ((0, 1), (1, 0), (1, 1), (1, -1))
    links = np.zeros((4, height, width), np.float32)
    undecided = undecided_pixels(odds)
    for place in undecided:
        for back in range(2):
            for k in range(4):
                y = place // width - back * steps[k][0]
                x = place % width - back * steps[k][1]
                v, u = y + steps[k][0], x + steps[k][1]
                if y >= 0 and 0 <= x < width and v < height and 0 <= u < width:
                    square = 0.0
                    for c in range(residual.shape[2]):
                        square += (residual[y, x, c] - residual[v, u, c]) ** 2
                    links[k, y, x] = strength * np.exp(-square / 18.0) * (1.0 if k < 2 else 0.7071)
    field = 0.5 * odds
    mean = np.tanh(field)
    for sweep in range(sweeps):
        for step in range(len(undecided)):
            place = undecided[step] if sweep % 2 == 0 else undecided[len(undecided) - 1 - step]
            y, x = place // width, place % width
            total = 0.5 * odds[y, x]
            for k in range(4):
                dy, dx = steps[k]
                if y + dy < height and 0 <= x + dx < width:
                    total += links[k, y, x] * mean[y + dy, x + dx]
                if y - dy >= 0 and 0 <= x - dx < width:
                    total += links[k, y - dy, x - dx] * mean[y - dy, x - dx]
            field[y, x] = total
            mean[y, x] = np.tanh(total)
    return field


@njit(cache=True, nogil=True)
def undecided_pixels(odds: np.ndarray) -> np.ndarray:
    """Returns the flat indices of the pixels that mean-field sweeps can change. A pixel can change if it has, within
    two pixels, log odds that are not clipped or that differ from its own."""
    height, width = odds.shape
    out = np.empty(height * width, np.int64)
    count = 0
    for y in range(height):
        for x in range(width):
            sure = abs(odds[y, x]) >= MAX_ODDS
            for v in range(max(0, y - 2), min(height, y + 3)):
                for u in range(max(0, x - 2), min(width, x + 3)):
                    sure = sure and odds[v, u] == odds[y, x]
                if not sure:
                    break
            if not sure:
                out[count] = y * width + x
                count += 1
    return out[:count]


@njit(cache=True, nogil=True)
def least_dissent(
    origin: np.ndarray,
    rays: np.ndarray,
    span: tuple[float, float],
    cameras: np.ndarray,
    distances: np.ndarray,
    scales: np.ndarray,
) -> np.ndarray:
    """Returns, for each ray (n), the smallest number (int8) of cameras that see background, over all points of the ray;
    -1 if ``MIN_WITNESSES`` cameras see no point of it. The count stops above ``MAX_DISSENT``.

    ``origin`` (3) and ``rays`` (n, 3) are in the world frame; points lie at distances in ``span`` (mm) along the rays.
    ``cameras`` are rows of ``packed_camera``. ``distances`` (k, h, w) are distances (px) to each camera's mask,
    negative where unknown, in images reduced by ``scales`` (k).
    """
    out = np.full(len(rays), -1, np.int8)
    step = (span[1] - span[0]) / STEPS
    for n in range(len(rays)):
        best = MAX_DISSENT + 1
        for s in range(STEPS):
            reach = span[0] + (s + 0.5) * step
            x, y, z = (origin[0] + reach * rays[n, 0], origin[1] + reach * rays[n, 1], origin[2] + reach * rays[n, 2])
            seen, against = 0, 0
            for k in range(len(cameras)):
                p = cameras[k]
                cx, cy, cz = placed(p, x, y, z)
                if cz <= NEAREST_MM:
                    continue
                column, row = distorted(cx / cz, cy / cz, p[LENS:])
                i, j = int((row + 0.5) / scales[k]), int((column + 0.5) / scales[k])
                if row < 0 or column < 0 or i >= distances.shape[1] or j >= distances.shape[2]:
                    continue
                away = distances[k, i, j]
                if away < 0:
                    continue
                seen += 1
                against += away > SLACK + 0.5 * step * p[LENS] / (cz * scales[k])
                if against >= best:
                    break
            if seen >= MIN_WITNESSES and against < best:
                best = against
                if best == 0:
                    break
        if best <= MAX_DISSENT:
            out[n] = best
        elif best == MAX_DISSENT + 1:
            out[n] = MAX_DISSENT
    return out


@njit(cache=True, nogil=True, inline="always")
def corner_of(x: int, size: int, small: int) -> tuple[int, float]:
    """Maps the centre of pixel ``x`` of an image with ``size`` columns (or rows) into an image with ``small`` columns
    (or rows). Returns the pixel before this position, and the fraction of the way to the next pixel."""
    at = min(max((x + 0.5) * small / size - 0.5, 0.0), small - 1.0)
    low = min(int(at), max(small - 2, 0))
    return low, at - low


@njit(cache=True, nogil=True, inline="always")
def interpolated_colour(a: np.ndarray, y: int, x: int, c: int, fy: float, fx: float) -> float:
    """Returns channel ``c`` of an image (h, w, 3), interpolated between pixel (y, x) and the pixels to its right and
    below."""
    return bilinear(a[y, x, c], a[y, x + 1, c], a[y + 1, x, c], a[y + 1, x + 1, c], fx, fy)


@njit(cache=True, nogil=True, inline="always")
def decoded_level(table: np.ndarray, code: float) -> float:
    """Converts an sRGB code (0 to 255, fractions allowed) to linear light by linear interpolation in ``table``."""
    code = min(max(code, 0.0), 255.0)
    low = int(code)
    return table[low] + (code - low) * (table[low + 1] - table[low])


@njit(cache=True, nogil=True, fastmath=True)
def solve_alpha(
    table: np.ndarray,
    image: np.ndarray,
    plates: np.ndarray,
    light: np.ndarray,
    sigma: np.ndarray,
    zone: np.ndarray,
    probability: np.ndarray,
    subject: np.ndarray,
    sigmas: tuple[float, float],
    first: bool,
) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Computes the subject's fraction of each pixel (alpha) from image I, background B and the subject's colour F, all
    in linear light. Alpha is the least-squares solution of I - B = q F - alpha B. Here q is alpha times the subject's
    relative brightness, at most ``BRIGHTEST`` alpha. Priors with the standard deviations ``sigmas`` keep q near alpha,
    and alpha near the coarse ``probability``.

    Args:
        table: linear light by sRGB code.
        image: (h, w, 3) codes.
        plates: clean plates (k, h, w, 3), whose mean is the background.
        light: ratio (r, c, 3) of the background's light to the plates'.
        sigma: standard deviation of the noise (r, c).
        zone: (r, c); 0 outside, 1 band along the outline, 2 inside, 3 band where the first estimate of F is unusable.
        probability: coarse alpha (r, c).
        subject: the subject's colour (r2, c2, 3), codes.
        sigmas: standard deviations of alpha about the coarse alpha, and of the subject's brightness.
        first: whether ``subject`` is a first estimate.

    Returns:
        Alpha (-0.5 to 1.5) and, in the band, |F - B| in standard deviations of the noise (-1 elsewhere) and the inverse
            variance of alpha (``MAX_ALPHA_INFORMATION`` elsewhere).
    """
    coarse_sigma, shade = sigmas
    height, width = image.shape[:2]
    ch, cw = zone.shape
    columns = np.minimum(np.arange(width) * cw // width, cw - 1)
    alpha = np.empty((height, width), np.float32)
    contrast = np.full((height, width), -1.0, np.float32)
    trust = np.full((height, width), MAX_ALPHA_INFORMATION, np.float32)
    for y in range(height):
        zy = min(y * ch // height, ch - 1)
        ly, fly = corner_of(y, height, ch)
        sy, fsy = corner_of(y, height, subject.shape[0])
        for x in range(width):
            zx = columns[x]
            kind = zone[zy, zx]
            if kind == 0 or kind == 2:
                alpha[y, x] = 0.0 if kind == 0 else 1.0
                continue
            lx, flx = corner_of(x, width, cw)
            p00, p01 = probability[ly, lx], probability[ly, lx + 1]
            p10, p11 = probability[ly + 1, lx], probability[ly + 1, lx + 1]
            prior = bilinear(p00, p01, p10, p11, flx, fly)
            if first and kind == 3:
                alpha[y, x] = prior
                continue
            sx, fsx = corner_of(x, width, subject.shape[1])
            noise = sigma[zy, zx]
            ff, fb, bb, df, db, dd = 0.0, 0.0, 0.0, 0.0, 0.0, 0.0  # sums in standard deviations
            for c in range(3):
                b = 0.0
                for k in range(len(plates)):
                    b += plates[k, y, x, c]
                b *= interpolated_colour(light, ly, lx, c, fly, flx) / len(plates)
                f = interpolated_colour(subject, sy, sx, c, fsy, fsx)
                code = min(int(0.5 * (f + b)), 255)
                scale = 1 / ((table[code + 1] - table[code]) * noise)
                b, f, i = (
                    scale * decoded_level(table, b),
                    scale * decoded_level(table, f),
                    scale * table[image[y, x, c]],
                )
                ff += f * f
                fb += f * b
                bb += b * b
                df += (i - b) * f
                db += (i - b) * b
                dd += (i - b) * (i - b)
            # Normal equations of I - B = q F - alpha B, q = alpha (within shade), alpha = prior (within coarse_sigma).
            m11, m12, m22 = ff + 1 / shade**2, -fb - 1 / shade**2, bb + 1 / shade**2 + 1 / coarse_sigma**2
            r1, r2 = df, -db + prior / coarse_sigma**2
            determinant = m11 * m22 - m12 * m12
            value, known = (m11 * r2 - m12 * r1) / determinant, determinant / m11
            if r1 * m22 - r2 * m12 > BRIGHTEST * (m11 * r2 - m12 * r1):  # q is above its bound: it is set to it
                m22 = BRIGHTEST**2 * ff - 2 * BRIGHTEST * fb + bb + ((BRIGHTEST - 1) / shade) ** 2 + 1 / coarse_sigma**2
                value, known = (BRIGHTEST * df + r2) / m22, m22
            square = ff - 2 * fb + bb
            value = min(1.5, max(-0.5, value))  # wide, because clipping noise at 0 and 1 would bend the ramp
            if (
                first
            ):  # what no mixture of the two explains, in any shade of the plate, is another colour of the subject
                a = min(1.0, max(0.0, value))
                left = dd - 2 * a * (df - db) + a * a * square
                along = min(0.0, max(-0.4 * (1 - a), (db - a * (fb - bb)) / max(bb, 1e-12)))  # 0: black
                left += along * along * bb - 2 * along * (db - a * (fb - bb))
                value += max(0.0, 1.0 - value) / (1.0 + np.exp(OTHER - 0.5 * left))
            alpha[y, x] = value
            known = max(known - 1 / coarse_sigma**2, 1e-6)
            contrast[y, x] = np.sqrt(known)
            trust[y, x] = min(MAX_ALPHA_INFORMATION, known)
    return alpha, contrast, trust
