"""Holds the compiled loop that interpolates label probabilities from cells to the pixels of a photograph."""

import numpy as np

from rig.jit import njit


@njit(cache=True, nogil=True, fastmath=True)
def spread_parts(slope, offset, size_px, grey, mask, out):
    """Fills ``out`` (h, w, 3; uint8) with the probabilities of skin, hair and clothes, in 255ths, at the pixels of
    ``mask`` (h, w). The probabilities are ``slope * grey + offset``, clipped to 0 to 1 and to a sum of at most 1.
    Pixels outside ``mask`` do not change.

    ``slope`` and ``offset`` (r, c, 3) are interpolated between the middles of cells of ``size_px`` pixels, and constant
    beyond the outermost cells; ``grey`` (h, w) is 0 to 255, and is scaled to 0 to 1.
    """
    rows, columns = slope.shape[:2]
    one, per = np.float32(1.0), np.float32(1.0 / 255.0)
    share = np.empty(3, np.float32)
    between = np.empty((columns, 6), np.float32)  # slopes and offsets at the height of a row of pixels
    for y in range(len(mask)):
        at = min(max((y + 0.5) / size_px - 0.5, 0.0), rows - 1.0)
        i = int(at)
        j, down = min(i + 1, rows - 1), np.float32(at - i)
        for x in range(columns):
            for part in range(3):
                between[x, part] = (one - down) * slope[i, x, part] + down * slope[j, x, part]
                between[x, 3 + part] = (one - down) * offset[i, x, part] + down * offset[j, x, part]
        for x in range(mask.shape[1]):
            if not mask[y, x]:
                continue
            along = min(max((x + 0.5) / size_px - 0.5, 0.0), columns - 1.0)
            left = int(along)
            next_, right, shade = min(left + 1, columns - 1), np.float32(along - left), per * np.float32(grey[y, x])
            total = np.float32(0.0)
            for part in range(3):
                steep = (one - right) * between[left, part] + right * between[next_, part]
                level = (one - right) * between[left, 3 + part] + right * between[next_, 3 + part]
                share[part] = min(max(steep * shade + level, np.float32(0.0)), one)
                total += share[part]
            per_part, left = np.float32(255.0) / max(total, one), 255
            for part in range(3):
                rounded = min(int(share[part] * per_part + np.float32(0.5)), left)
                out[y, x, part] = rounded
                left -= rounded
