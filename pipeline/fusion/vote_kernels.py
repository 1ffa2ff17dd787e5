"""Contains compiled loops that combine the depths of all views at a point to a signed distance, and bound it by the
silhouettes. Other loops write the outline distances of a view and find views that contradict them. The last loops
measure the offsets of a mesh's vertices from the depth maps, and smooth these offsets.
"""

from typing import NamedTuple

import numpy as np

from pipeline.geometry.projection_kernels import LENS, NEAREST_MM, distorted, pinhole, placed
from pipeline.imaging.sampling_kernels import bilinear, held, sample
from rig.jit import njit

TURNED = 0.4  # cosine between the normals of a vertex and of a pixel below which the pixel shows another surface
STEP_MM = 4.0  # four pixels that differ by more in depth show two surfaces
NORMAL, SIGMA, OUTLINE, FRAME = 0, 3, 4, 5  # columns of ``Pixels.shown``; the normal has three
# What one step of a column is: a thousandth of a millimetre and a 32nd of a pixel are far below what is measured.
NORMAL_STEP, SIGMA_STEP_MM, PIXEL_STEP = 1 / 32767, 1e-3, 1 / 32
UNKNOWN = -1  # deviation of a pixel whose depth is not known
CENTRE = 16  # of a camera's row: its centre
MAX_VIEWS = 64
PLANE_SHARE = 0.3  # of the way along the ray that a place before a surface is off at least, however flat that is seen
THICKEST_MM = 60.0  # of a body behind its surface, where no silhouette bounds it
UNDECIDED = -1.0  # weight of a place inside of the outlines that only their guess beyond the photographs leaves out
WIDENING = 1.0  # beyond a photograph a body may widen by as much as it lies beyond it: shoulders do
FLATTEST = 0.1  # cosine beyond which a tangent plane says nothing of a place beside it
BLOCK = 4  # pixels along the side of what is decided at once
STRIDE = 3  # every third pixel of every third row stands for the others
CLEAR_PX = 2.5  # a point nearer to the outline is ordinary: blur, hair, calibration
SURE_MM = 1.0  # points with a larger deviation do not count


class Pixels(NamedTuple):
    """Holds the arrays of ``view_stack.ViewStack`` under the same names."""

    cameras: np.ndarray
    sizes: np.ndarray
    starts: np.ndarray
    depth_mm: np.ndarray
    shown: np.ndarray


@njit(cache=True, nogil=True, error_model="numpy")
def vote(
    index: np.ndarray,
    corner: np.ndarray,
    step_mm: float,
    views: Pixels,
    limits: np.ndarray,
    value: np.ndarray,
    weight: np.ndarray,
    bound: np.ndarray,
    first: int,
    last: int,
) -> None:
    """Combines the views at grid nodes ``first`` to ``last``. Fills in, for each node, ``value`` (mm, positive
    outside), ``weight``, and ``bound`` (mm), the smallest possible value.

    A view's vote is the distance to the tangent plane of the pixel at the node's projection. Votes are limited to
    ``reach`` in front of the plane, and left out if the node lies more than ``behind`` behind it. The value is the mean
    of the views' votes near their weighted median; the weight is multiplied by the square of the share that lies there.
    A node without any view's vote has weight 0 (or ``UNDECIDED``). The value of a node without votes is the distance to
    the visual hull, or to the back of a body of limited thickness behind a seen surface.

    ``index`` (n, 3) and ``corner`` (3, world frame, mm) give the positions of nodes, ``step_mm`` apart. ``limits`` are
    reach, behind, largest difference of agreeing votes, the deviation (mm) of unit weight and the lower limit of
    deviations.
    """
    cameras, sizes, starts, depths, shown = views
    reach, behind, agreement, unit, floor = limits
    votes, weights, place = np.empty(MAX_VIEWS), np.empty(MAX_VIEWS), np.empty(3)
    for n in range(first, last):
        for axis in range(3):
            place[axis] = corner[axis] + step_mm * index[n, axis]
        count = 0
        hull, hull_next = -1e9, -1e9  # largest and second largest distance outside a silhouette
        guess = -1e9  # the largest one with silhouettes that go on, widening, beyond their photographs
        hidden = 1e9  # smallest depth behind a surface that is seen
        for v in range(len(cameras)):
            depth, column, row = seen_at(cameras[v], place)
            if depth <= NEAREST_MM:
                continue
            at, beyond = nearest_pixel(column, row, sizes[v])
            at += starts[v]
            scale = depth / cameras[v, LENS]
            edge, off = (PIXEL_STEP * shown[at, FRAME] + beyond) * scale, PIXEL_STEP * shown[at, OUTLINE] * scale
            guess = max(guess, off - WIDENING * beyond * scale)
            if edge > 0.0:
                continue
            hull, hull_next = max(hull, off), max(hull_next, min(hull, off))
            if hull_next > reach:
                break  # two silhouettes say that nobody is there
            if beyond > 0.0 or shown[at, SIGMA] == UNKNOWN:
                continue
            sigma = SIGMA_STEP_MM * shown[at, SIGMA]
            facing = max(cosine(cameras[v], place, depth, shown[at]), FLATTEST)
            before = (depths[at] - depth) * facing
            if before < -behind:
                hidden = min(hidden, depth - depths[at])
                continue
            share = min(unit * unit / (sigma * sigma + floor * floor) * min(1.0, 2.0 * facing), 2.0)
            if before < 0.0:
                share *= 1.0 + 0.75 * before / behind
            votes[count] = min(max(before, PLANE_SHARE * (depths[at] - depth)), reach)
            weights[count] = share
            count += 1
        bound[n] = min(max(hull, -reach), reach)
        value[n], weight[n] = agreed(votes, weights, count, agreement)
        if hull_next > reach:  # whatever views before those two say
            value[n], weight[n] = reach, 0.0
        elif count == 0:
            body = min(max(guess, hull), max(hidden - THICKEST_MM, hull))
            value[n] = min(max(body, -reach), reach)
            if hull < 0.0 < body:
                weight[n] = UNDECIDED


@njit(cache=True, nogil=True, inline="always", error_model="numpy")
def seen_at(camera: np.ndarray, place: np.ndarray) -> tuple[float, float, float]:
    """Projects a point (world frame, mm) into a camera, which is a row of ``view_stack.ViewStack.cameras``. Returns the
    point's depth (mm), column and row (px)."""
    x, y, depth = placed(camera, place[0], place[1], place[2])
    inverse = 1.0 / depth  # one division: they are what takes long here
    column, row = pinhole(inverse * x, inverse * y, camera[LENS:])
    return depth, column, row


@njit(cache=True, nogil=True, inline="always", error_model="numpy")
def nearest_pixel(column: float, row: float, size: np.ndarray) -> tuple[int, float]:
    """Returns the flat index of the pixel nearest to an image point, and the distance (px) of the point outside the
    image. ``size`` is the image's height and width."""
    inside_column, inside_row = min(max(column, 0.0), size[1] - 1.0), min(max(row, 0.0), size[0] - 1.0)
    beyond = 0.0
    if inside_column != column or inside_row != row:
        beyond = np.sqrt((column - inside_column) ** 2 + (row - inside_row) ** 2)
    return int(inside_row + 0.5) * size[1] + int(inside_column + 0.5), beyond


@njit(cache=True, nogil=True, inline="always", error_model="numpy")
def cosine(camera: np.ndarray, place: np.ndarray, depth: float, shown: np.ndarray) -> float:
    """Returns the cosine between a pixel's normal and the direction to the camera, times the ray's length for each mm
    of depth. The product with a difference in depth is the distance to the pixel's tangent plane."""
    x, y, z = place[0] - camera[CENTRE], place[1] - camera[CENTRE + 1], place[2] - camera[CENTRE + 2]
    return -NORMAL_STEP * (x * shown[NORMAL] + y * shown[NORMAL + 1] + z * shown[NORMAL + 2]) / depth


@njit(cache=True, nogil=True, inline="always", error_model="numpy")
def agreed(votes: np.ndarray, weights: np.ndarray, count: int, agreement: float) -> tuple[float, float]:
    """Returns the mean of the votes that differ from the weighted median by at most ``agreement``, and their weight
    times the square of their fraction of the total weight; 0 and 0 without votes. Sorts the first ``count`` entries of
    the two arrays."""
    if count == 0:
        return 0.0, 0.0
    total = 0.0
    for a in range(count):
        total += weights[a]
        b = a
        while b > 0 and votes[b - 1] > votes[b]:
            votes[b - 1], votes[b] = votes[b], votes[b - 1]
            weights[b - 1], weights[b] = weights[b], weights[b - 1]
            b -= 1
    passed, middle = 0.0, votes[count - 1]
    for a in range(count):
        passed += weights[a]
        if passed >= 0.5 * total:
            middle = votes[a]
            break
    mean, agreeing = 0.0, 0.0
    for a in range(count):
        if abs(votes[a] - middle) <= agreement:
            mean += weights[a] * votes[a]
            agreeing += weights[a]
    if agreeing <= 0.0:
        return 0.0, 0.0
    share = agreeing / total
    return mean / agreeing, agreeing * share * share


@njit(cache=True, nogil=True, error_model="numpy")
def mark_contradicted(target: int, views: Pixels, blocks: np.ndarray, width: int) -> None:
    """Marks blocks of the view ``target`` in which another view v has a precise surface point outside the target's
    outline. Sets bit v % 64 of ``blocks`` (rows, columns; 64-bit words), in place.

    ``width`` is the width of the target's image in pixels. A block is ``BLOCK`` pixels wide.
    """
    cameras, sizes, starts, depths, shown = views
    place = np.empty(3)
    for v in range(len(cameras)):
        if v == target:
            continue
        p, bit = cameras[v], np.uint64(1) << np.uint64(v % 64)
        for row in range(0, sizes[v, 0], STRIDE):
            for column in range(0, sizes[v, 1], STRIDE):
                at = starts[v] + row * sizes[v, 1] + column
                if shown[at, SIGMA] == UNKNOWN or shown[at, SIGMA] * SIGMA_STEP_MM >= SURE_MM:
                    continue
                depth = depths[at]
                x, y = (column - p[LENS + 2]) / p[LENS] * depth, (row - p[LENS + 3]) / p[LENS + 1] * depth
                for axis in range(3):  # the rotation's inverse, from the camera's centre
                    place[axis] = p[axis] * x + p[3 + axis] * y + p[6 + axis] * depth + p[CENTRE + axis]
                ahead, at_column, at_row = seen_at(cameras[target], place)
                if ahead <= NEAREST_MM:
                    continue
                near, beyond = nearest_pixel(at_column, at_row, sizes[target])
                there = starts[target] + near
                if beyond == 0.0 and shown[there, FRAME] < 0 and shown[there, OUTLINE] * PIXEL_STEP > CLEAR_PX:
                    blocks[near // width // BLOCK, near % width // BLOCK] |= bit


@njit(cache=True, nogil=True)
def write_outline(crop: np.ndarray, lens: np.ndarray, width: int, distance: np.ndarray, shown: np.ndarray) -> None:
    """Fills two columns of ``shown``, in units of ``PIXEL_STEP``, at the pixels of an undistorted crop. The columns are
    the signed distances (px of the crop, negative inside) to the silhouette's contour and to the photograph's border.

    Outside the photograph the contour distance is copied from the nearest border pixel, so that a shoulder continues
    beyond the border. ``crop`` is fx, fy, cx, cy of the crop, ``width`` its width; ``lens`` is the photograph's
    (``packed_lens``); ``distance`` (rows, columns) is the silhouette's signed distance.
    """
    rows, columns = distance.shape
    steps = crop[0] / lens[0] / PIXEL_STEP  # a crop of fewer pixels has shorter distances
    for at in range(len(shown)):
        u, v = distorted((at % width - crop[2]) / crop[0], (at // width - crop[3]) / crop[1], lens)
        shown[at, FRAME] = _stepped(steps * max(max(-u, u - (columns - 1)), max(-v, v - (rows - 1))))
        shown[at, OUTLINE] = _stepped(steps * sample(distance, held(u, columns), held(v, rows)))


@njit(cache=True, nogil=True, inline="always")
def _stepped(value: float) -> int:
    return round(min(max(value, -32767.0), 32767.0))


@njit(cache=True, nogil=True, error_model="numpy")
def measure(
    vertices: np.ndarray,
    normals: np.ndarray,
    seen: Pixels,
    limits: np.ndarray,
    offset: np.ndarray,
    information: np.ndarray,
    scatter: np.ndarray,
    views: np.ndarray,
    first: int,
    last: int,
) -> None:
    """Measures the offsets of vertices ``first`` to ``last`` (world frame, mm) from the depth maps' surface, and fills
    arrays with one entry for each vertex.

    ``offset`` is the distance (mm along the vertex normal); ``information`` its inverse variance (mm^-2) for
    independent views; ``scatter`` the variance between the views (mm^2); ``views`` the number of views that agree.
    ``limits`` are the distance (mm) beyond which a view shows another surface, the largest difference (mm) of agreeing
    views, and a lower limit of a view's standard deviation (mm).
    """
    cameras, sizes, starts, depths, shown = seen
    gate, agreement, floor = limits
    votes, weights = np.empty(MAX_VIEWS), np.empty(MAX_VIEWS)
    for n in range(first, last):
        place, count = vertices[n], 0
        for v in range(len(cameras)):
            depth, column, row = seen_at(cameras[v], place)
            if depth <= NEAREST_MM:
                continue
            near, beyond = nearest_pixel(column, row, sizes[v])
            near += starts[v]
            if beyond > 0.0 or shown[near, SIGMA] == UNKNOWN:
                continue
            sigma, turn = SIGMA_STEP_MM * shown[near, SIGMA], 0.0
            for axis in range(3):
                turn += NORMAL_STEP * shown[near, NORMAL + axis] * normals[n, axis]
            facing = cosine(cameras[v], place, depth, shown[near])
            if turn < TURNED or facing < FLATTEST:
                continue
            behind = (depth - depth_between(depths, shown, starts[v], sizes[v], column, row, near)) * facing
            if abs(behind) > gate:
                continue
            votes[count] = behind
            weights[count] = min(1.0, 2.0 * facing) / (sigma * sigma * facing * facing + floor * floor)
            count += 1
        mean, _ = agreed(votes, weights, count, agreement)
        total, squares, agreeing = 0.0, 0.0, 0
        for a in range(count):
            if abs(votes[a] - mean) <= agreement:
                total += weights[a]
                squares += weights[a] * (votes[a] - mean) ** 2
                agreeing += 1
        offset[n], information[n], views[n] = mean, total, agreeing
        scatter[n] = squares / total if agreeing else 0.0


@njit(cache=True, nogil=True, inline="always", error_model="numpy")
def depth_between(
    depths: np.ndarray, shown: np.ndarray, start: int, size: np.ndarray, column: float, row: float, near: int
) -> float:
    """Returns the depth (mm) at a point between four pixels. The depth is interpolated if all four show the same
    surface, else it is that of the nearest pixel, with index ``near`` in ``shown``. ``start`` is the index of the
    view's first pixel."""
    c, r = min(int(column), size[1] - 2), min(int(row), size[0] - 2)
    a = start + r * size[1] + c
    b, d, e = a + 1, a + size[1], a + size[1] + 1
    least = min(min(shown[a, SIGMA], shown[b, SIGMA]), min(shown[d, SIGMA], shown[e, SIGMA]))
    low, high = (
        min(min(depths[a], depths[b]), min(depths[d], depths[e])),
        max(max(depths[a], depths[b]), max(depths[d], depths[e])),
    )
    if least == UNKNOWN or high - low > STEP_MM:
        return depths[near]
    return bilinear(depths[a], depths[b], depths[d], depths[e], column - c, row - r)


@njit(cache=True, nogil=True, error_model="numpy")
def smooth_offsets(
    start: np.ndarray,
    offset: np.ndarray,
    information: np.ndarray,
    starts: np.ndarray,
    indices: np.ndarray,
    root_stiffness: np.ndarray,
    sweeps: int,
    factor: float,
) -> np.ndarray:
    """Smooths offsets d (n) over the mesh. Minimises ``sum information (d - offset)^2 + sum over edges r r' (d -
    d')^2`` by successive over-relaxation from ``start``, with the ``root_stiffness`` r at the edge's ends. The
    neighbours of vertex v are ``indices[starts[v]:starts[v + 1]]``."""
    out = start.copy()
    for _ in range(sweeps):
        for v in range(len(out)):
            if root_stiffness[v] == 0.0:
                continue
            total, weight = information[v] * offset[v], information[v]
            for k in range(starts[v], starts[v + 1]):
                edge = root_stiffness[v] * root_stiffness[indices[k]]
                total += edge * out[indices[k]]
                weight += edge
            if weight > 0.0:
                out[v] += factor * (total / weight - out[v])
    return out


@njit(cache=True, nogil=True, error_model="numpy")
def blurred_over_mesh(values: np.ndarray, starts: np.ndarray, indices: np.ndarray, steps: int) -> np.ndarray:
    """Smooths values (n, k) at vertices: in each of ``steps`` a value becomes the average of itself and its neighbours'
    mean. The neighbours of vertex v are ``indices[starts[v]:starts[v + 1]]``."""
    one, other, last = values.copy(), np.empty_like(values), values.shape[1] - 1
    for _ in range(steps):
        for v in range(len(values)):
            first, end = np.uint32(starts[v]), np.uint32(starts[v + 1])
            share = 0.5 / max(end - first, 1)
            for c in range(0, last + 1, 2):  # two columns at a time; an odd last one twice
                d = min(c + 1, last)
                total, beside = 0.0, 0.0
                for k in range(first, end):
                    at = np.uint32(indices[k])
                    total += one[at, c]
                    beside += one[at, d]
                other[v, c] = 0.5 * one[v, c] + share * total
                other[v, d] = 0.5 * one[v, d] + share * beside
        one, other = other, one
    return one
