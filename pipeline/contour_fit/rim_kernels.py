"""Contains the compiled loops of ``rim``. The first loops pass over the mesh for all views at once; the later loops
treat one view each, in parallel."""

from typing import NamedTuple

import numpy as np

from pipeline.geometry.projection_kernels import placed, project, projection_slopes, turned
from pipeline.imaging.sampling_kernels import cell, sample_row
from rig.jit import njit

POSE = 7  # rotation, translation, log scale
BLOCK = 1024  # faces whose planes stay in the cache while all views look at them
# Columns of a sample: weight of its edge's second vertex; world point; d(outline along its normal) / d(point), before
# that the surface normal; pixel; the outline's normal; px of outline that it stands for; signed distance read there;
# the sample found before it on an edge of the same first vertex.
BLEND, X, Y, Z, SLOPE, U, V, NX, NY, LENGTH, RESIDUAL, NEXT, COLUMNS = 0, 1, 2, 3, 4, 7, 8, 9, 10, 11, 12, 13, 14
LONGEST_PX = 16.0  # between neighbours on the rim; farther apart, or turned by more than 60 degrees, they are no curve


class Surface(NamedTuple):
    """Holds a mesh (world frame, mm). Columns of an edge are from, to (as in its first face), first face, second face
    or -1."""

    vertices: np.ndarray
    normals: np.ndarray
    faces: np.ndarray
    edges: np.ndarray


class Sweep(NamedTuple):
    """Holds a 64-bit word for each face, edge and vertex; bit k is the orientation towards view k."""

    facing: np.ndarray  # of all faces: that look to the view
    outline: np.ndarray  # edges where the number of layers changes in some view,
    outline_words: np.ndarray
    behind: np.ndarray  # of all vertices: whose normals look away
    crossed: np.ndarray  # faces that the rim crosses in some view,
    crossed_words: np.ndarray


class Pictures(NamedTuple):
    """Holds the views: rows of cameras (``packed_camera``), their centres (world frame, mm), and the signed distance
    maps (px) of all views in one array."""

    cameras: np.ndarray
    centres: np.ndarray
    size: np.ndarray  # width, height
    distance: np.ndarray
    offset: np.ndarray


@njit(cache=True, fastmath=True)
def projected_with_slopes(points, view, cameras):
    """Projects each point (n, 3; world, mm) into its own ``view`` (n). Returns the pixels (n, 2) and their derivatives
    by the point (n, 2, 3; px per mm)."""
    pixels, slopes = np.empty((len(points), 2)), np.empty((len(points), 2, 3))
    for n in range(len(points)):
        camera = cameras[view[n]]
        x, y, z = points[n, 0], points[n, 1], points[n, 2]
        pixels[n, 0], pixels[n, 1] = project(camera, x, y, z)
        of_column, of_row = projection_slopes(camera, x, y, z)
        for c in range(3):
            slopes[n, 0, c], slopes[n, 1, c] = of_column[c], of_row[c]
    return pixels, slopes


@njit(cache=True, fastmath=True)
def normals_and_planes(vertices, faces):
    """Returns unit vertex normals (v, 3), and each face's plane: normal n and offset n . a (4, f)."""
    normals = np.zeros_like(vertices)
    planes = np.empty((4, len(faces)))
    for f in range(len(faces)):
        a, b, c = faces[f, 0], faces[f, 1], faces[f, 2]
        ux, uy, uz = vertices[b, 0] - vertices[a, 0], vertices[b, 1] - vertices[a, 1], vertices[b, 2] - vertices[a, 2]
        wx, wy, wz = vertices[c, 0] - vertices[a, 0], vertices[c, 1] - vertices[a, 1], vertices[c, 2] - vertices[a, 2]
        nx, ny, nz = uy * wz - uz * wy, uz * wx - ux * wz, ux * wy - uy * wx
        for v in (a, b, c):
            normals[v, 0] += nx
            normals[v, 1] += ny
            normals[v, 2] += nz
        planes[0, f], planes[1, f], planes[2, f] = nx, ny, nz
        planes[3, f] = nx * vertices[a, 0] + ny * vertices[a, 1] + nz * vertices[a, 2]
    for v in range(len(normals)):
        length = np.sqrt(normals[v, 0] ** 2 + normals[v, 1] ** 2 + normals[v, 2] ** 2) + 1e-30
        for c in range(3):
            normals[v, c] /= length
    return normals, planes


@njit(cache=True, fastmath=True)
def _facing(planes, centres):
    """Returns one word for each face; bit k is set where the face is turned towards view k."""
    words = np.zeros(planes.shape[1], np.uint64)
    for first in range(0, len(words), BLOCK):
        last = min(first + BLOCK, len(words))
        for k in range(len(centres)):
            x, y, z = centres[k, 0], centres[k, 1], centres[k, 2]
            bit = np.uint64(1) << np.uint64(k)
            for f in range(first, last):
                in_front = planes[0, f] * x + planes[1, f] * y + planes[2, f] * z > planes[3, f]
                words[f] |= bit if in_front else np.uint64(0)
    return words


@njit(cache=True, fastmath=True)
def _side(vertex, normal, centre):
    """Returns the product N . (X - C), which is zero on the rim."""
    x, y, z = vertex[0] - centre[0], vertex[1] - centre[1], vertex[2] - centre[2]
    return normal[0] * x + normal[1] * y + normal[2] * z


@njit(cache=True, fastmath=True)
def _back_facing(vertices, normals, centres):
    """Returns one word for each vertex; bit k is set where its normal points away from view k."""
    words = np.zeros(len(vertices), np.uint64)
    for v in range(len(vertices)):
        word = np.uint64(0)
        for k in range(len(centres)):
            if _side(vertices[v], normals[v], centres[k]) > 0:
                word |= np.uint64(1) << np.uint64(k)
        words[v] = word
    return words


@njit(cache=True, fastmath=True)
def _silhouette_edges(edges, facing):
    """Returns the silhouette edges and border edges of the mesh, each with a bit mask of its views."""
    count = 0
    for e in range(len(edges)):
        if edges[e, 3] < 0 or facing[edges[e, 2]] != facing[edges[e, 3]]:
            count += 1
    which, words = np.empty(count, np.int32), np.empty(count, np.uint64)
    i = 0
    for e in range(len(edges)):
        if edges[e, 3] < 0:
            which[i], words[i] = e, ~np.uint64(0)
        elif facing[edges[e, 2]] != facing[edges[e, 3]]:
            which[i], words[i] = e, facing[edges[e, 2]] ^ facing[edges[e, 3]]
        else:
            continue
        i += 1
    return which, words


@njit(cache=True, fastmath=True)
def _crossed(faces, active, behind):
    """Returns the active faces that the rim crosses in any view, each with a bit mask of these views."""
    which, words = np.empty(len(active), np.int32), np.empty(len(active), np.uint64)
    count = 0
    for s in range(len(active)):
        f = active[s]
        a, b, c = faces[f, 0], faces[f, 1], faces[f, 2]
        word = (behind[a] ^ behind[b]) | (behind[a] ^ behind[c])
        if word:
            which[count], words[count] = active[s], word
            count += 1
    return which[:count], words[:count]


@njit(cache=True, fastmath=True)
def _chain(surface, sweep, bit, camera):
    """Projects the silhouette edges of one view: x0 y0 x1 y1 and a number of layers in each row. An edge has the
    direction of its front-facing face, or the reverse of its back-facing face."""
    vertices, total = surface.vertices, 0
    for word in sweep.outline_words:
        total += 1 if word & bit else 0
    chain = np.empty((total, 5))
    i = 0
    for j in range(len(sweep.outline)):
        if not sweep.outline_words[j] & bit:
            continue
        e = sweep.outline[j]
        a, b, one, two = surface.edges[e, 0], surface.edges[e, 1], surface.edges[e, 2], surface.edges[e, 3]
        if not sweep.facing[one] & bit:
            a, b = b, a
        chain[i, 0], chain[i, 1] = project(camera, vertices[a, 0], vertices[a, 1], vertices[a, 2])
        chain[i, 2], chain[i, 3] = project(camera, vertices[b, 0], vertices[b, 1], vertices[b, 2])
        chain[i, 4] = 1.0 if two < 0 else 2.0
        i += 1
    return chain


@njit(cache=True, fastmath=True)
def _rows(chain, height):
    """Sorts the projected silhouette edges into the image rows that they cross. Returns where each row starts, and for
    every entry the edge's y0, y1, x0, dx/dy and signed number of layers."""
    start = np.zeros(height + 1, np.int64)
    for i in range(len(chain)):
        low, high = min(chain[i, 1], chain[i, 3]), max(chain[i, 1], chain[i, 3])
        if high > 1e8 or high < 0 or low >= height or low == high:
            continue
        for row in range(max(0, int(np.floor(low))), min(height - 1, int(np.floor(high))) + 1):
            start[row + 1] += 1
    for row in range(height):
        start[row + 1] += start[row]
    entries = np.empty((5, start[height]))
    fill = start[:-1].copy()
    for i in range(len(chain)):
        x0, y0, x1, y1, layers = chain[i, 0], chain[i, 1], chain[i, 2], chain[i, 3], chain[i, 4]
        low, high = min(y0, y1), max(y0, y1)
        if high > 1e8 or high < 0 or low >= height or low == high:
            continue
        for row in range(max(0, int(np.floor(low))), min(height - 1, int(np.floor(high))) + 1):
            m = fill[row]
            entries[0, m], entries[1, m], entries[2, m] = y0, y1, x0
            entries[3, m], entries[4, m] = (x1 - x0) / (y1 - y0), layers if y1 > y0 else -layers
            fill[row] += 1
    return start, entries


@njit(cache=True, fastmath=True)
def _layers(x, y, start, entries):
    """Returns the winding number of the silhouette edges around a pixel, which is the number of faces over it."""
    row = int(np.floor(y))
    if row < 0 or row >= len(start) - 1:
        return 1.0  # outside the image nothing is known; such samples are dropped
    count = 0.0
    for m in range(start[row], start[row + 1]):
        across = (entries[0, m] <= y) != (entries[1, m] <= y)
        right = entries[2, m] + (y - entries[0, m]) * entries[3, m] > x
        count += entries[4, m] if across and right else 0.0
    return count


@njit(cache=True, fastmath=True)
def _read(pictures, k, x, y):
    """Interpolates the signed distance map of view k at a pixel."""
    width, height = pictures.size[k, 0], pictures.size[k, 1]
    column, right = cell(x, width)
    row, down = cell(y, height)
    return sample_row(pictures.distance, pictures.offset[k] + row * width + column, width, right, down)


@njit(cache=True, fastmath=True)
def _crossings(surface, sweep, bit, centre, corners, samples):
    """Finds the zero crossings of N . (X - C) along the edges of the crossed faces. Fills in each sample's edge, blend,
    point and normal (in the slope's columns). Returns the number of samples, and the segments between them."""
    vertices, normals, faces, behind = surface.vertices, surface.normals, surface.faces, sweep.behind
    kept_index = np.full(len(vertices), -1, np.int32)
    segments = np.empty((corners.shape[0], 2), np.int32)
    count = joined = 0
    ends = np.empty(2, np.int32)
    for s in range(len(sweep.crossed)):
        if not sweep.crossed_words[s] & bit:
            continue
        f = sweep.crossed[s]
        n = 0
        for j in range(3):
            k = (j + 1) % 3
            a, b = min(faces[f, j], faces[f, k]), max(faces[f, j], faces[f, k])
            if not (behind[a] ^ behind[b]) & bit:
                continue
            # An edge has at most two faces: the sample that the first made is found by its ends.
            found = -1
            probe = kept_index[a]
            while probe >= 0:
                if corners[probe, 1] == b:
                    found = probe
                    break
                probe = np.int32(samples[probe, NEXT])
            if found < 0:
                if count >= corners.shape[0]:
                    return count, joined, segments
                found = count
                count += 1
                here, there = _side(vertices[a], normals[a], centre), _side(vertices[b], normals[b], centre)
                t = min(max(here / (here - there), 0.0), 1.0)
                corners[found, 0], corners[found, 1] = a, b
                samples[found, BLEND] = t
                # The chord lies below the surface: by t (1 - t) / 2 (n_b - n_a) . (b - a), its sagitta.
                bend = 0.0
                for c in range(3):
                    bend += (normals[b, c] - normals[a, c]) * (vertices[b, c] - vertices[a, c])
                for c in range(3):
                    samples[found, SLOPE + c] = (1.0 - t) * normals[a, c] + t * normals[b, c]
                    lift = 0.5 * t * (1.0 - t) * bend * samples[found, SLOPE + c]
                    samples[found, X + c] = (1.0 - t) * vertices[a, c] + t * vertices[b, c] + lift
                samples[found, LENGTH] = 0.0
                samples[found, NEXT] = kept_index[a]
                kept_index[a] = found
            if n < 2:
                ends[n] = found
            n += 1
        if n == 2 and joined < len(segments):
            segments[joined, 0], segments[joined, 1] = ends[0], ends[1]
            joined += 1
    return count, joined, segments


@njit(cache=True, fastmath=True)
def _view(k, surface, sweep, bit, pictures, steps, averaged, corners, samples):
    """Fills ``corners`` and ``samples`` with the rim samples of one view on the outer outline; returns their number."""
    camera = pictures.cameras[k]
    width, height = pictures.size[k, 0], pictures.size[k, 1]
    start, entries = _rows(_chain(surface, sweep, bit, camera), height)
    count, joined, segments = _crossings(surface, sweep, bit, pictures.centres[k], corners, samples)
    for s in range(count):
        samples[s, U], samples[s, V] = project(camera, samples[s, X], samples[s, Y], samples[s, Z])
    for j in range(joined):
        a, b = segments[j, 0], segments[j, 1]
        dx, dy = samples[b, U] - samples[a, U], samples[b, V] - samples[a, V]
        half = 0.5 * np.sqrt(dx * dx + dy * dy)
        samples[a, LENGTH] += half
        samples[b, LENGTH] += half
    kept, place = 0, np.full(count, -1, np.int32)
    for s in range(count):
        u, v = samples[s, U], samples[s, V]
        if not (0.0 <= u <= width - 1.0 and 0.0 <= v <= height - 1.0):
            continue
        to_x, to_y = projection_slopes(camera, samples[s, X], samples[s, Y], samples[s, Z])
        # l = N^T P^+ through the 2 x 2 normal matrix of P's rows.
        n0, n1, n2 = samples[s, SLOPE], samples[s, SLOPE + 1], samples[s, SLOPE + 2]
        g00 = to_x[0] ** 2 + to_x[1] ** 2 + to_x[2] ** 2
        g11 = to_y[0] ** 2 + to_y[1] ** 2 + to_y[2] ** 2
        g01 = to_x[0] * to_y[0] + to_x[1] * to_y[1] + to_x[2] * to_y[2]
        h0 = to_x[0] * n0 + to_x[1] * n1 + to_x[2] * n2
        h1 = to_y[0] * n0 + to_y[1] * n1 + to_y[2] * n2
        det = g00 * g11 - g01 * g01
        lx, ly = (g11 * h0 - g01 * h1) / det, (g00 * h1 - g01 * h0) / det
        size = np.sqrt(lx * lx + ly * ly) + 1e-30
        nx, ny = lx / size, ly / size
        covered = False
        for i in range(len(steps)):
            if _layers(u + steps[i] * nx, v + steps[i] * ny, start, entries) != 0:
                covered = True
                break
        if covered:
            continue
        corners[kept, 0], corners[kept, 1] = corners[s, 0], corners[s, 1]
        for c in range(SLOPE):  # blend and point
            samples[kept, c] = samples[s, c]
        for c in range(3):
            samples[kept, SLOPE + c] = nx * to_x[c] + ny * to_y[c]
        samples[kept, U], samples[kept, V], samples[kept, NX], samples[kept, NY] = u, v, nx, ny
        samples[kept, LENGTH] = samples[s, LENGTH]
        samples[kept, RESIDUAL] = _read(pictures, k, u, v)
        place[s] = kept
        kept += 1
    if averaged:
        _average(segments[:joined], place, kept, pictures, k, samples)
    return kept


@njit(cache=True, fastmath=True)
def _average(segments, place, kept, pictures, k, samples):
    """Replaces each sample's signed distance by its mean along the outline, half way to the neighbouring samples.

    Samples are 2 to 6 px apart, and the outline's noise is independent after 2 px, so reading at the samples alone
    would lose half of the information.
    """
    total, read = np.zeros(kept), np.zeros(kept)
    for j in range(len(segments)):
        a, b = place[segments[j, 0]], place[segments[j, 1]]
        if a < 0 or b < 0:
            continue
        dx, dy = samples[b, U] - samples[a, U], samples[b, V] - samples[a, V]
        half = 0.5 * np.sqrt(dx * dx + dy * dy)
        turn_x, turn_y = samples[b, NX] - samples[a, NX], samples[b, NY] - samples[a, NY]
        if 2.0 * half > LONGEST_PX or turn_x * turn_x + turn_y * turn_y > 1.0:
            continue
        bend = turn_x * dx + turn_y * dy  # the outline bulges over the chord by t (1 - t) / 2 of it, its sagitta
        reads = int(half) + 1
        for i in range(2 * reads):
            t = (i + 0.5) / (2 * reads)
            end = a if i < reads else b
            lift = 0.5 * t * (1.0 - t) * bend
            x = samples[a, U] + t * dx + lift * samples[end, NX]
            y = samples[a, V] + t * dy + lift * samples[end, NY]
            total[end] += half / reads * _read(pictures, k, x, y)
        read[a] += half
        read[b] += half
    for s in range(kept):
        if samples[s, LENGTH] > 0.0:
            samples[s, RESIDUAL] = (total[s] + (samples[s, LENGTH] - read[s]) * samples[s, RESIDUAL]) / samples[
                s, LENGTH
            ]


@njit(cache=True, nogil=True, fastmath=True)
def sweep_views(surface, planes, active, centres):
    """Computes the ``Sweep`` of at most 64 views with camera ``centres`` (k, 3; world frame, mm). ``active`` are the
    faces whose rim is searched."""
    facing = _facing(planes, centres)
    outline, outline_words = _silhouette_edges(surface.edges, facing)
    behind = _back_facing(surface.vertices, surface.normals, centres)
    crossed, crossed_words = _crossed(surface.faces, active, behind)
    return Sweep(facing, outline, outline_words, behind, crossed, crossed_words)


@njit(cache=True, nogil=True, fastmath=True)
def find_rim_samples(first, last, surface, sweep, pictures, steps, averaged, counts, corners, samples):
    """Finds the rim samples of views ``first`` to ``last``. Fills in, for each view k, ``counts[k]``, ``corners[k]``
    (the two vertices of each sample's edge) and ``samples[k]``.

    ``steps`` are distances (px) outside the outline at which no part of the model may lie. ``averaged`` is explained at
    ``find_rim``.
    """
    for k in range(first, last):
        bit = np.uint64(1) << np.uint64(k)
        counts[k] = _view(k, surface, sweep, bit, pictures, steps, averaged, corners[k], samples[k])


class Level(NamedTuple):
    """Holds the modes of a coarse mesh, the cage (v0, 3, m; head frame, mm), and the sparse matrix (``indptr``,
    ``indices``, ``data``) that interpolates them to a mesh level."""

    indptr: np.ndarray
    indices: np.ndarray
    data: np.ndarray
    modes: np.ndarray


class RimSamples(NamedTuple):
    """Holds the columns of ``rim.Rim`` that the Jacobian needs, with one row for each rim sample."""

    view: np.ndarray
    corner: np.ndarray
    blend: np.ndarray
    point: np.ndarray
    gradient: np.ndarray


@njit(cache=True, nogil=True, fastmath=True)
def fill_rows(first, last, level, count, turn, place, cameras, rim, out):
    """Fills the Jacobian rows ``out[first:last]`` of rim samples: the derivative of the residual (px) by ``count``
    coefficients, by pose (rotation, translation, log scale) and by the correction of the camera that sees the sample
    (rotation, translation). The equations are in ``rim_term``.

    ``turn`` is scale times rotation (3, 3) and ``place`` the translation (3, mm) of world_from_head; ``cameras`` has
    the rows of ``Views.packed``. The derivative by a coefficient is the gradient times the mode at the sample, which is
    interpolated from the cage's vertices.
    """
    indptr, indices, data, modes = level
    view, corner, blend, point, gradient = rim
    for s in range(first, last):
        gx, gy, gz = gradient[s, 0], gradient[s, 1], gradient[s, 2]
        hx = gx * turn[0, 0] + gy * turn[1, 0] + gz * turn[2, 0]
        hy = gx * turn[0, 1] + gy * turn[1, 1] + gz * turn[2, 1]
        hz = gx * turn[0, 2] + gy * turn[1, 2] + gz * turn[2, 2]
        row = np.zeros(count, np.float32)
        for end in range(2):
            share = blend[s] if end else 1.0 - blend[s]
            v = corner[s, end]
            for j in range(indptr[v], indptr[v + 1]):
                i, w = indices[j], share * data[j]
                wx, wy, wz = np.float32(w * hx), np.float32(w * hy), np.float32(w * hz)
                for m in range(count):
                    row[m] += wx * modes[i, 0, m] + wy * modes[i, 1, m] + wz * modes[i, 2, m]
        for m in range(count):
            out[s, m] = row[m]
        _fill_rigid(point[s, 0] - place[0], point[s, 1] - place[1], point[s, 2] - place[2], gx, gy, gz, out[s], count)
        out[s, count + 6] = (
            gx * (point[s, 0] - place[0]) + gy * (point[s, 1] - place[1]) + gz * (point[s, 2] - place[2])
        )
        camera = cameras[view[s]]
        x, y, z = placed(camera, point[s, 0], point[s, 1], point[s, 2])
        ax, ay, az = turned(camera, gx, gy, gz)
        _fill_rigid(x, y, z, ax, ay, az, out[s], count + POSE)


@njit(cache=True, fastmath=True)
def _fill_rigid(x, y, z, gx, gy, gz, out, first):
    """Fills in the derivatives by rotation and translation: g . (w x arm) = w . (arm x g), and g."""
    out[first], out[first + 1], out[first + 2] = y * gz - z * gy, z * gx - x * gz, x * gy - y * gx
    out[first + 3], out[first + 4], out[first + 5] = gx, gy, gz
