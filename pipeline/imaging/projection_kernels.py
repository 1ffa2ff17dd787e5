"""Compiled loops of ``pipeline.imaging.projection``."""

from pipeline.compiled import njit

NOWHERE = 1e9  # a pixel outside of every image


@njit(cache=True, nogil=True, fastmath=True)
def distorted(x, y, lens):
    """Pixel (column, row) of the ray (x, y, 1); NOWHERE past the turning radius."""
    r2 = x * x + y * y
    if r2 > lens[9] * lens[9]:
        return NOWHERE, NOWHERE
    radial = 1.0 + r2 * (lens[4] + r2 * (lens[5] + r2 * lens[8]))
    u = x * radial + 2.0 * lens[6] * x * y + lens[7] * (r2 + 2.0 * x * x)
    v = y * radial + lens[6] * (r2 + 2.0 * y * y) + 2.0 * lens[7] * x * y
    return lens[0] * u + lens[2], lens[1] * v + lens[3]
