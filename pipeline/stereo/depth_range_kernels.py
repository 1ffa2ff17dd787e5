"""Compiled loop that finds the range of depths along each ray that the silhouettes leave to the subject."""

from pipeline.geometry.projection_kernels import NEAREST_MM, placed
from pipeline.stereo.matching_kernels import HEIGHT, START, UNSEEN_PX, WIDTH
from rig.jit import njit


@njit(cache=True, nogil=True, error_model="numpy")
def _distance_at(distance_px, way, x, y):
    """Signed distance at the nearest pixel; beyond the crop that of its edge."""
    width, height = int(way[WIDTH]), int(way[HEIGHT])
    column = min(max(int(x + 0.5), 0), width - 1)
    row = min(max(int(y + 0.5), 0), height - 1)
    return distance_px[int(way[START]) + row * width + column]


@njit(cache=True, nogil=True, error_model="numpy")
def find_depth_range(start, ways, distance_px, slack_px, low, high, step, near, far):
    """Fills ``near`` and ``far`` (h, w; mm of depth, 0 for none) for the pixels of one view: the first and the last
    depth at which the point of the ray is inside the visual hull. Depths between may be outside.

    Depths from ``low`` to ``high`` are tried at every ``step`` (mm). A point is inside if no view that sees it shows it
    outside the silhouette by more than ``slack_px``, and at least one other view sees it. ``distance_px`` holds the
    signed distances of all views, this view's from ``start`` on; ``ways`` are rows of ``Stack.homographies``.
    """
    height, width = near.shape
    for row in range(height):
        for column in range(width):
            near[row, column] = 0.0
            far[row, column] = 0.0
            here = distance_px[start + row * width + column]
            if here > slack_px or here < UNSEEN_PX:
                continue
            z = low
            while z <= high:
                seen = 0
                for k in range(len(ways)):
                    x, y, depth = placed(ways[k], z * column, z * row, z)
                    if depth < NEAREST_MM:
                        continue
                    distance = _distance_at(distance_px, ways[k], x / depth, y / depth)
                    if distance > slack_px:
                        seen = 0
                        break
                    if distance > UNSEEN_PX:
                        seen += 1
                if seen > 0:
                    if near[row, column] == 0.0:
                        near[row, column] = z
                    far[row, column] = z
                z += step
