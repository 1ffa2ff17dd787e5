"""Compiled loops that improve the depths of a view: planes taken over from neighbours, and steps of least squares."""

import numpy as np

from pipeline.stereo.matching_kernels import (
    UNSEEN_PX,
    Loaded,
    correlate_and_slide,
    distance_there,
    farthest,
    load_window,
    place_window,
)
from pipeline.stereo.sweep_kernels import cost_of
from rig.jit import njit

MIN_CORRELATION = 0.3  # correlation of a view that may speak
BEHIND_BEST = 0.35  # a view that is less alike than the best by this is taken for hidden


@njit(cache=True, nogil=True, error_model="numpy", fastmath=True, allocates=False)
def propagate(sight, scratch, parity, steps, same_mm, fresh, depth, slopes, cost):
    """Lets every pixel of one colour of the chequerboard (``parity``) try the planes of its neighbours of the other
    colour, ``steps`` pixels away (odd), and keeps the best of these and its own. Changes ``fresh``, ``depth``,
    ``slopes`` and ``cost`` (h, w) in place.

    A cost below 0 is not yet known. A plane that differs from the current one by less than ``same_mm``, at the pixel
    and one pixel beside it, is not tried. ``fresh`` marks planes that their neighbours have not tried yet; a pixel
    whose cost is known tries only those. Planes taken over here become fresh.
    """
    height, width = depth.shape
    window, scores, place = scratch.window, scratch.scores, scratch.place
    reach = farthest(sight.pattern)
    for row in range(height):
        for column in range((row + parity) % 2, width, 2):
            best = cost[row, column]
            if depth[row, column] <= 0.0 or (best >= 0.0 and not _is_beside(fresh, row, column, steps)):
                continue
            total, energy = load_window(sight, width, height, column, row, window)
            loaded = Loaded(column, row, window, total, energy)
            best_z, best_x, best_y = depth[row, column], slopes[row, column, 0], slopes[row, column, 1]
            known = best >= 0.0
            if not known:
                best = cost_of(sight, loaded, best_z, best_x, best_y, reach, place, scores)
            for step in steps:
                for side in range(4):
                    i = (step, -step, 0, 0)[side]
                    j = (0, 0, step, -step)[side]
                    if not (0 <= column + i < width and 0 <= row + j < height):
                        continue
                    there = depth[row + j, column + i]
                    if there <= 0.0 or (known and not fresh[row + j, column + i]):
                        continue
                    z_x, z_y = slopes[row + j, column + i, 0], slopes[row + j, column + i, 1]
                    z = there - i * z_x - j * z_y
                    if abs(z - best_z) < same_mm and abs(z_x - best_x) + abs(z_y - best_y) < same_mm:
                        continue
                    value = cost_of(sight, loaded, z, z_x, z_y, reach, place, scores)
                    if value < best:
                        best, best_z, best_x, best_y = value, z, z_x, z_y
                        fresh[row, column] = True
            cost[row, column] = best
            depth[row, column] = best_z
            slopes[row, column, 0] = best_x
            slopes[row, column, 1] = best_y


@njit(cache=True, nogil=True, error_model="numpy", inline="always")
def _is_beside(fresh, row, column, steps):
    height, width = fresh.shape
    for step in steps:
        if (
            (column + step < width and fresh[row, column + step])
            or (column >= step and fresh[row, column - step])
            or (row + step < height and fresh[row + step, column])
            or (row >= step and fresh[row - step, column])
        ):
            return True
    return False


@njit(cache=True, nogil=True, error_model="numpy", fastmath=True, allocates=False)
def slide(sight, scratch, most_px, depth, slopes, place_mm, information, likeness):
    """Makes one step of least squares on the depth of every pixel (h, w), with all views in which it looks alike.

    Fills ``place_mm`` (the new depth, at most ``most_px`` away in the view that is most sensitive to it), its
    ``information`` (mm^-2, samples taken as independent; 0 where nothing is known), and ``likeness``, the mean
    correlation.
    """
    height, width = depth.shape
    ways, window, place, found = sight.ways, scratch.window, scratch.place, scratch.found
    reach = farthest(sight.pattern)
    for row in range(height):
        for column in range(width):
            z = depth[row, column]
            place_mm[row, column] = z
            information[row, column] = 0.0
            likeness[row, column] = 0.0
            if z <= 0.0:
                continue
            total, energy = load_window(sight, width, height, column, row, window)
            loaded = Loaded(column, row, window, total, energy)
            best, fastest, count = 0.0, 0.0, 0
            for k in range(len(ways)):
                if not place_window(
                    ways[k], z, slopes[row, column, 0], slopes[row, column, 1], column, row, reach, place
                ):
                    continue
                beside = distance_there(ways[k], place, sight.distance_px)
                if beside > 0.0 or beside < UNSEEN_PX:
                    continue
                correlate_and_slide(ways[k], place, sight, loaded, found[count])
                best = max(best, found[count, 0])
                fastest = max(fastest, place[6] * place[6] + place[7] * place[7])
                count += 1
            gradient, curvature, mean, spoke = 0.0, 0.0, 0.0, 0
            for k in range(count):
                if found[k, 0] > MIN_CORRELATION and found[k, 0] > best - BEHIND_BEST:
                    gradient += found[k, 1]
                    curvature += found[k, 2]
                    mean += found[k, 0]
                    spoke += 1
            if spoke > 0 and curvature > 0.0:
                most = most_px / np.sqrt(fastest)
                place_mm[row, column] = z + min(max(gradient / curvature, -most), most)
                # Noise resembles itself by chance: a window counts by the share of its contrast that is not noise.
                information[row, column] = curvature * max(
                    1.0 - total * sight.noise * sight.noise / max(energy, 1e-6), 0.0
                )
                likeness[row, column] = mean / spoke
