"""Compiled loops of the depth range: how far along each ray the silhouettes leave room for the subject."""

from pipeline.compiled import njit
from pipeline.dense.matching_kernels import UNSEEN_PX


@njit(cache=True, nogil=True, error_model="numpy")
def _distance_at(distance_px, start, width, height, x, y):
    """Signed distance at the nearest pixel; beyond the crop that of its edge."""
    column = min(max(int(x + 0.5), 0), width - 1)
    row = min(max(int(y + 0.5), 0), height - 1)
    return distance_px[start + row * width + column]


@njit(cache=True, nogil=True, error_model="numpy")
def find_room(view, size, offset, distance_px, turn, shift, slack_px, low, high, step, near, far):
    """Fills ``near`` and ``far`` (mm of depth, for the view's pixels row by row; 0 where no room is).

    A place is inside where no view that sees it shows it beside the subject by more than ``slack_px``, and at least one
    other sees it. The range goes from the first such place to the last: what lies between may be empty.
    """
    width, height = size[view]
    for row in range(height):
        for column in range(width):
            p = row * width + column
            near[p] = 0.0
            far[p] = 0.0
            here = distance_px[offset[view] + p]
            if here > slack_px or here < UNSEEN_PX:
                continue
            z = low
            while z <= high:
                seen = 0
                for k in range(len(size)):
                    if k == view:
                        continue
                    turned = turn[view, k]
                    depth = z * (turned[2, 0] * column + turned[2, 1] * row + turned[2, 2]) + shift[view, k, 2]
                    if depth < 1.0:
                        continue
                    x = (z * (turned[0, 0] * column + turned[0, 1] * row + turned[0, 2]) + shift[view, k, 0]) / depth
                    y = (z * (turned[1, 0] * column + turned[1, 1] * row + turned[1, 2]) + shift[view, k, 1]) / depth
                    distance = _distance_at(distance_px, offset[k], size[k, 0], size[k, 1], x, y)
                    if distance > slack_px:
                        seen = 0
                        break
                    if distance > UNSEEN_PX:
                        seen += 1
                if seen > 0:
                    if near[p] == 0.0:
                        near[p] = z
                    far[p] = z
                z += step
