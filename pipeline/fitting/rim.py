"""The rim of a head as every camera sees it, without drawing a single image.

For X on the surface with normal N seen from C_k the rim is ``N . (X - C_k) = 0``: the zero crossing of vertex normals,
linearly interpolated along mesh edges. A rim point is on the *outer* outline if a step outwards leaves the model's
mask. That is decided exactly: the faces that look towards the camera all keep their orientation in the image, and those
that look away all lose it, so that the number of faces over a pixel is the winding number of the image of the edges
where the two sets meet (they count twice) or end (once). That chain is about a thousand edges a view, sorted into image
rows, and a query is one walk along a row: no mask, no distance transform of the model, and no loose visibility test
(one of |D_model| < 0.6 px lets inner facets through, and the fit stalls).

With P = d(pixel)/dX the image normal of the outline is ``n = l / |l|, l = N^T P^+``, since the tangent plane at the rim
holds the viewing ray; so ``n^T P = N^T / |l|``, and the sliding of the rim along the surface drops out at first order.
"""

from dataclasses import dataclass

import numpy as np
from jaxtyping import Bool, Float, Float32, Int, Int32
from numba import njit

from pipeline.fitting.threads import in_threads
from pipeline.lens import NOWHERE, distorted, packed_lens
from rig.layout import Rig

SAMPLES_MOST = 6000  # rim samples of one view; a full head has about 1,000
VIEWS_A_WORD = 64  # views that are swept together, a bit each
BLOCK = 1024  # faces whose planes stay in the cache while all views look at them
STEPS_OUT_PX = (0.3, 2.5)  # both must leave the mask: the second drops samples at the edge of T-junctions and grooves


@dataclass(frozen=True, slots=True, eq=False)
class Topology:
    """What the rim needs to know of a mesh level; computed once."""

    faces: Int32[np.ndarray, "f 3"]
    edges: Int32[np.ndarray, "e 4"]  # from, to (as in face one), face one, face two or -1
    face: Int32[np.ndarray, " s"]  # triangles of the face region, whose rim may always speak
    head: Int32[np.ndarray, " t"]  # those and cranium and ears, whose rim speaks where there is no hair


@dataclass(frozen=True, slots=True, eq=False)
class Views:
    """The cameras and their signed distances, packed for compiled loops."""

    names: tuple[str, ...]
    rotation: Float[np.ndarray, "k 3 3"]
    translation: Float[np.ndarray, "k 3"]
    lens: Float[np.ndarray, "k 10"]  # packed_lens of each
    size: Int32[np.ndarray, "k 2"]  # width, height
    distance: Float32[np.ndarray, " pixels"]  # all views, one after the other, row by row
    offset: Int[np.ndarray, " k"]


@dataclass(frozen=True, slots=True, eq=False)
class Rim:
    """Samples of the outer outline, all views together."""

    view: Int32[np.ndarray, " s"]
    corner: Int32[np.ndarray, "s 2"]  # the edge's two vertices
    blend: Float[np.ndarray, " s"]  # weight of the second one
    point: Float[np.ndarray, "s 3"]  # world, mm
    gradient: Float[np.ndarray, "s 3"]  # n^T P: change of the outline's position along n (px) per mm of the point
    pixel: Float[np.ndarray, "s 2"]
    normal: Float[np.ndarray, "s 2"]  # outward, unit, in the image
    length: Float[np.ndarray, " s"]  # px of outline that the sample stands for
    residual: Float[np.ndarray, " s"]  # D_obs, px; negative: the model lies inside the input


def make_topology(
    faces: Int[np.ndarray, "f 3"],
    face_region: Bool[np.ndarray, " v"],
    head_region: Bool[np.ndarray, " v"] | None = None,
) -> Topology:
    """Edges with their two faces; ``head_region`` is the whole mesh by default. Raises ValueError where more than two
    faces share an edge."""
    faces = np.ascontiguousarray(faces, np.int32)
    directed = np.concatenate([faces[:, [0, 1]], faces[:, [1, 2]], faces[:, [2, 0]]])
    owner = np.tile(np.arange(len(faces), dtype=np.int32), 3)
    low, high = directed.min(axis=1).astype(np.int64), directed.max(axis=1).astype(np.int64)
    order = np.argsort(low * (faces.max() + 1) + high, kind="stable")
    key = (low * (faces.max() + 1) + high)[order]
    first = np.flatnonzero(np.r_[True, key[1:] != key[:-1]])
    count = np.diff(np.r_[first, len(key)])
    if count.max() > 2:
        raise ValueError(f"{(count > 2).sum()} edges have more than two faces")
    edges = np.full((len(first), 4), -1, np.int32)
    edges[:, :2], edges[:, 2] = directed[order[first]], owner[order[first]]
    edges[count == 2, 3] = owner[order[first[count == 2] + 1]]
    everything = np.ones(len(faces), bool)
    head = everything if head_region is None else (face_region | head_region)[faces].all(axis=1)
    regions = (np.flatnonzero(of).astype(np.int32) for of in (face_region[faces].all(axis=1), head))
    return Topology(faces, edges, *regions)


def pack_views(rig: Rig, distances: dict[str, Float32[np.ndarray, "h w"]]) -> Views:
    """The cameras of ``rig`` that have a signed distance."""
    cameras = [camera for camera in rig if camera.name in distances]
    maps = [np.ascontiguousarray(distances[camera.name], np.float32) for camera in cameras]
    return Views(
        names=tuple(camera.name for camera in cameras),
        rotation=np.stack([camera.camera_from_world.rotation for camera in cameras]),
        translation=np.stack([camera.camera_from_world.translation for camera in cameras]),
        lens=np.stack([packed_lens(camera) for camera in cameras]),
        size=np.array([m.shape[::-1] for m in maps], np.int32),
        distance=np.concatenate([m.ravel() for m in maps]),
        offset=np.cumsum([0] + [m.size for m in maps])[:-1].astype(np.int64),
    )


def find_rim(
    topology: Topology, vertices_world: Float[np.ndarray, "v 3"], views: Views, *, whole_head: bool = False
) -> Rim:
    """The outer outline of a mesh in every view, and the input's signed distance there."""
    faces = topology.head if whole_head else topology.face
    vertices = np.ascontiguousarray(vertices_world)
    normals, planes = _normals_and_planes(vertices, topology.faces)
    words = [slice(k, k + VIEWS_A_WORD) for k in range(0, len(views.names), VIEWS_A_WORD)]
    found = [part for some in words for part in _outlines(topology, vertices, normals, planes, faces, views, some)]
    view = np.repeat(np.arange(len(found), dtype=np.int32), [len(corner) for corner, _ in found])
    corner, values = (np.concatenate([part[i] for part in found]) for i in (0, 1))
    return Rim(
        view, corner, values[:, 0], values[:, 1:4], values[:, 4:7], values[:, 7:9], values[:, 9:11], values[:, 11],
        values[:, 12],
    )  # fmt: skip


def _outlines(
    topology: Topology,
    vertices: Float[np.ndarray, "v 3"],
    normals: Float[np.ndarray, "v 3"],
    planes: Float[np.ndarray, "4 f"],
    speaking: Int32[np.ndarray, " s"],
    views: Views,
    some: slice,
) -> list[tuple[Int32[np.ndarray, "n 2"], Float[np.ndarray, "n 13"]]]:
    """Of each view, at most VIEWS_A_WORD: corners, and the columns of ``Rim`` from the blend on.

    Faces and vertices are swept once for all views, a bit for each; a view then only touches what lies on its rim.
    """
    rotation, translation = views.rotation[some], views.translation[some]
    centres = -np.einsum("kji,kj->ki", rotation, translation)
    swept = _swept(vertices, normals, planes, topology.faces, topology.edges, speaking, centres)
    counts = np.zeros(len(rotation), np.int64)
    corners = np.empty((len(rotation), SAMPLES_MOST, 2), np.int32)
    floats = np.empty((len(rotation), SAMPLES_MOST, 14))

    def see(first: int, last: int) -> None:
        _see(
            first, last, vertices, normals, topology.faces, topology.edges, *swept, rotation, translation,
            views.lens[some], views.size[some], views.distance, views.offset[some], np.array(STEPS_OUT_PX), counts,
            corners, floats,
        )  # fmt: skip

    in_threads(len(rotation), see)
    return [(corners[k, :count], floats[k, :count, :13]) for k, count in enumerate(counts.tolist())]


def project_with_slopes(
    points_world: Float[np.ndarray, "n 3"], view: Int[np.ndarray, " n"], views: Views
) -> tuple[Float[np.ndarray, "n 2"], Float[np.ndarray, "n 2 3"]]:
    """Pixel of every point in the view named beside it, and d(pixel) / d(point)."""
    return _project_with_slopes(points_world, view, views.rotation, views.translation, views.lens)


@njit(cache=True, fastmath=True)
def _project_with_slopes(points, view, rotation, translation, lens):
    pixels, slopes = np.empty((len(points), 2)), np.empty((len(points), 2, 3))
    for n in range(len(points)):
        k = view[n]
        pixels[n] = _project(points[n], rotation[k], translation[k], lens[k])
        slopes[n] = _projection_jacobian(points[n], rotation[k], translation[k], lens[k])
    return pixels, slopes


@njit(cache=True, fastmath=True)
def _normals_and_planes(vertices, faces):
    """Unit vertex normals; and by face its normal n and n . a: a centre C is in front of it where n . C > n . a."""
    normals = np.zeros_like(vertices)
    planes = np.empty((4, len(faces)))
    for f in range(len(faces)):
        a, b, c = faces[f]
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
        normals[v] /= length
    return normals, planes


@njit(cache=True, fastmath=True)
def _project(point, rotation, translation, lens):
    """Pixel of a world point; not finite behind the camera or past the lens's turning radius."""
    x = rotation[0, 0] * point[0] + rotation[0, 1] * point[1] + rotation[0, 2] * point[2] + translation[0]
    y = rotation[1, 0] * point[0] + rotation[1, 1] * point[1] + rotation[1, 2] * point[2] + translation[1]
    z = rotation[2, 0] * point[0] + rotation[2, 1] * point[1] + rotation[2, 2] * point[2] + translation[2]
    if z <= 1.0:
        return NOWHERE, NOWHERE
    return distorted(x / z, y / z, lens)


@njit(cache=True, fastmath=True)
def _slopes(point, rotation, translation, lens):
    """P = d(pixel) / d(world point): the two rows, x and y, as six numbers."""
    x = rotation[0, 0] * point[0] + rotation[0, 1] * point[1] + rotation[0, 2] * point[2] + translation[0]
    y = rotation[1, 0] * point[0] + rotation[1, 1] * point[1] + rotation[1, 2] * point[2] + translation[1]
    iz = 1.0 / (rotation[2, 0] * point[0] + rotation[2, 1] * point[1] + rotation[2, 2] * point[2] + translation[2])
    x, y = x * iz, y * iz
    r2 = x * x + y * y
    radial = 1.0 + r2 * (lens[4] + r2 * (lens[5] + r2 * lens[8]))
    slope = 2.0 * (lens[4] + r2 * (2.0 * lens[5] + 3.0 * r2 * lens[8]))
    xy = slope * x * y + 2.0 * lens[6] * x + 2.0 * lens[7] * y
    xx = lens[0] * iz * (radial + slope * x * x + 2.0 * lens[6] * y + 6.0 * lens[7] * x)
    yy = lens[1] * iz * (radial + slope * y * y + 6.0 * lens[6] * y + 2.0 * lens[7] * x)
    xy, yx = lens[0] * iz * xy, lens[1] * iz * xy
    dx0, dx1, dx2 = (
        rotation[0, 0] - x * rotation[2, 0],
        rotation[0, 1] - x * rotation[2, 1],
        rotation[0, 2] - x * rotation[2, 2],
    )
    dy0, dy1, dy2 = (
        rotation[1, 0] - y * rotation[2, 0],
        rotation[1, 1] - y * rotation[2, 1],
        rotation[1, 2] - y * rotation[2, 2],
    )
    return (
        (xx * dx0 + xy * dy0, xx * dx1 + xy * dy1, xx * dx2 + xy * dy2),
        (yx * dx0 + yy * dy0, yx * dx1 + yy * dy1, yx * dx2 + yy * dy2),
    )


@njit(cache=True, fastmath=True)
def _projection_jacobian(point, rotation, translation, lens):
    """P = d(pixel) / d(world point), 2 x 3."""
    return np.array(_slopes(point, rotation, translation, lens))


@njit(cache=True, fastmath=True)
def _facing(planes, centres):
    """By face a word: bit k is set where it looks to view k."""
    words = np.zeros(planes.shape[1], np.uint64)
    for first in range(0, len(words), BLOCK):
        last = min(first + BLOCK, len(words))
        for k in range(len(centres)):
            x, y, z = centres[k]
            bit = np.uint64(1) << np.uint64(k)
            for f in range(first, last):
                in_front = planes[0, f] * x + planes[1, f] * y + planes[2, f] * z > planes[3, f]
                words[f] |= bit if in_front else np.uint64(0)
    return words


@njit(cache=True, fastmath=True)
def _side(vertex, normal, centre):
    """N . (X - C): its zero crossings are the rim."""
    x, y, z = vertex[0] - centre[0], vertex[1] - centre[1], vertex[2] - centre[2]
    return normal[0] * x + normal[1] * y + normal[2] * z


@njit(cache=True, fastmath=True)
def _turned(vertices, normals, centres):
    """By vertex a word: bit k is set where its normal looks away from view k."""
    words = np.zeros(len(vertices), np.uint64)
    for v in range(len(vertices)):
        word = np.uint64(0)
        for k in range(len(centres)):
            if _side(vertices[v], normals[v], centres[k]) > 0:
                word |= np.uint64(1) << np.uint64(k)
        words[v] = word
    return words


@njit(cache=True, fastmath=True)
def _folds(edges, facing):
    """The edges where the number of layers changes in some view, and the word of those views; borders in all."""
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
def _crossed(faces, speaking, turned):
    """The speaking faces that the rim crosses in some view, and the word of those views."""
    which, words = np.empty(len(speaking), np.int32), np.empty(len(speaking), np.uint64)
    count = 0
    for s in range(len(speaking)):
        a, b, c = faces[speaking[s]]
        word = (turned[a] ^ turned[b]) | (turned[a] ^ turned[c])
        if word:
            which[count], words[count] = speaking[s], word
            count += 1
    return which[:count], words[:count]


@njit(cache=True, fastmath=True)
def _chain(vertices, edges, folds, words, bit, facing, rotation, translation, lens):
    """Image of one view's folds: x0 y0 x1 y1, directed as in the face that looks to the camera (against the direction
    in one that looks away), and by how many layers."""
    total = 0
    for word in words:
        total += 1 if word & bit else 0
    chain = np.empty((total, 5))
    i = 0
    for j in range(len(folds)):
        if not words[j] & bit:
            continue
        a, b, one, two = edges[folds[j]]
        if not facing[one] & bit:
            a, b = b, a
        chain[i, 0], chain[i, 1] = _project(vertices[a], rotation, translation, lens)
        chain[i, 2], chain[i, 3] = _project(vertices[b], rotation, translation, lens)
        chain[i, 4] = 1.0 if two < 0 else 2.0
        i += 1
    return chain


@njit(cache=True, fastmath=True)
def _rows(chain, height):
    """The chain's edges sorted into the image rows that they cross: where each row starts, and for every entry the
    edge's y0, y1, x0, dx/dy and signed layers. Copies, not indices: a query then reads one stretch of memory."""
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
        x0, y0, x1, y1, layers = chain[i]
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
    """Winding number of the chain about a pixel: how many faces lie over it."""
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
def _bilinear(distance, offset, width, height, x, y):
    x0, y0 = min(max(int(np.floor(x)), 0), width - 2), min(max(int(np.floor(y)), 0), height - 2)
    fx, fy = x - x0, y - y0
    i = offset + y0 * width + x0
    top = distance[i] * (1.0 - fx) + distance[i + 1] * fx
    bottom = distance[i + width] * (1.0 - fx) + distance[i + width + 1] * fx
    return top * (1.0 - fy) + bottom * fy


@njit(cache=True, fastmath=True)
def _crossings(vertices, normals, turned, faces, crossed, words, bit, centre, corners, floats):
    """Zero crossings of N . (X - C) along the edges of the crossed faces; each edge once. Fills the sample's edge,
    blend, point, normal (in the place of the gradient); returns how many, and the segments that join them."""
    kept_index = np.full(len(vertices), -1, np.int32)
    segments = np.empty((corners.shape[0], 2), np.int32)
    count = joined = 0
    ends = np.empty(2, np.int32)
    for s in range(len(crossed)):
        if not words[s] & bit:
            continue
        f = crossed[s]
        n = 0
        for j in range(3):
            k = (j + 1) % 3
            a, b = min(faces[f, j], faces[f, k]), max(faces[f, j], faces[f, k])
            if not (turned[a] ^ turned[b]) & bit:
                continue
            # An edge has at most two faces: the sample that the first made is found by its ends.
            found = -1
            probe = kept_index[a]
            while probe >= 0:
                if corners[probe, 1] == b:
                    found = probe
                    break
                probe = np.int32(floats[probe, 13])
            if found < 0:
                if count >= corners.shape[0]:
                    return count, joined, segments
                found = count
                count += 1
                here, there = _side(vertices[a], normals[a], centre), _side(vertices[b], normals[b], centre)
                t = min(max(here / (here - there), 0.0), 1.0)
                corners[found, 0], corners[found, 1] = a, b
                floats[found, 0] = t
                # The chord lies below the surface: by t (1 - t) / 2 (n_b - n_a) . (b - a), its sagitta.
                bend = 0.0
                for c in range(3):
                    bend += (normals[b, c] - normals[a, c]) * (vertices[b, c] - vertices[a, c])
                for c in range(3):
                    floats[found, 4 + c] = (1.0 - t) * normals[a, c] + t * normals[b, c]
                    lift = 0.5 * t * (1.0 - t) * bend * floats[found, 4 + c]
                    floats[found, 1 + c] = (1.0 - t) * vertices[a, c] + t * vertices[b, c] + lift
                floats[found, 11] = 0.0
                floats[found, 13] = kept_index[a]
                kept_index[a] = found
            if n < 2:
                ends[n] = found
            n += 1
        if n == 2 and joined < len(segments):
            segments[joined, 0], segments[joined, 1] = ends[0], ends[1]
            joined += 1
    return count, joined, segments


@njit(cache=True, fastmath=True)
def _view(vertices, normals, faces, edges, facing, folds, fold_words, turned, crossed, crossed_words, bit, rotation,
          translation, lens, width, height, distance, offset, steps, corners, floats):  # fmt: skip
    """One view: fills ``corners`` and ``floats`` with the samples on the outer outline; returns their number."""
    centre = -(rotation.T @ translation)
    chain = _chain(vertices, edges, folds, fold_words, bit, facing, rotation, translation, lens)
    start, entries = _rows(chain, height)
    count, joined, segments = _crossings(
        vertices, normals, turned, faces, crossed, crossed_words, bit, centre, corners, floats
    )
    for s in range(count):
        floats[s, 7], floats[s, 8] = _project(floats[s, 1:4], rotation, translation, lens)
    for j in range(joined):
        a, b = segments[j]
        half = 0.5 * np.sqrt((floats[a, 7] - floats[b, 7]) ** 2 + (floats[a, 8] - floats[b, 8]) ** 2)
        floats[a, 11] += half
        floats[b, 11] += half
    kept = 0
    for s in range(count):
        u, v = floats[s, 7], floats[s, 8]
        if not (0.0 <= u <= width - 1.0 and 0.0 <= v <= height - 1.0):
            continue
        to_x, to_y = _slopes(floats[s, 1:4], rotation, translation, lens)
        # l = N^T P^+ through the 2 x 2 normal matrix of P's rows.
        n0, n1, n2 = floats[s, 4], floats[s, 5], floats[s, 6]
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
        for c in range(4):
            floats[kept, c] = floats[s, c]
        for c in range(3):
            floats[kept, 4 + c] = nx * to_x[c] + ny * to_y[c]
        floats[kept, 7], floats[kept, 8], floats[kept, 9], floats[kept, 10] = u, v, nx, ny
        floats[kept, 11] = floats[s, 11]
        floats[kept, 12] = _bilinear(distance, offset, width, height, u, v)
        kept += 1
    return kept


@njit(cache=True, nogil=True, fastmath=True)
def _swept(vertices, normals, planes, faces, edges, speaking, centres):
    """What all views ask of faces, edges and vertices: a bit of a word for each view."""
    facing = _facing(planes, centres)
    folds, fold_words = _folds(edges, facing)
    turned = _turned(vertices, normals, centres)
    crossed, crossed_words = _crossed(faces, speaking, turned)
    return facing, folds, fold_words, turned, crossed, crossed_words


@njit(cache=True, nogil=True, fastmath=True)
def _see(first, last, vertices, normals, faces, edges, facing, folds, fold_words, turned, crossed, crossed_words,
         rotation, translation, lens, size, distance, offset, steps, counts, corners, floats):  # fmt: skip
    for k in range(first, last):
        counts[k] = _view(
            vertices, normals, faces, edges, facing, folds, fold_words, turned, crossed, crossed_words,
            np.uint64(1) << np.uint64(k), rotation[k], translation[k], lens[k], size[k, 0], size[k, 1], distance,
            offset[k], steps, corners[k], floats[k],
        )  # fmt: skip
