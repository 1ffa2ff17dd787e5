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
from numba import njit, prange

from rig.layout import Rig

SAMPLES_MOST = 6000  # rim samples of one view; a full head has about 1,000
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
    lens: Float[np.ndarray, "k 10"]  # fx fy cx cy k1 k2 p1 p2 k3 turning radius
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
    lens = []
    for camera in cameras:
        k, d = camera.intrinsics, camera.intrinsics.distortion
        lens.append([k.fx, k.fy, k.cx, k.cy, *d.opencv(), min(d.turning_radius(), 1e6)])
    maps = [np.ascontiguousarray(distances[camera.name], np.float32) for camera in cameras]
    return Views(
        names=tuple(camera.name for camera in cameras),
        rotation=np.stack([camera.camera_from_world.rotation for camera in cameras]),
        translation=np.stack([camera.camera_from_world.translation for camera in cameras]),
        lens=np.array(lens),
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
    normals = _vertex_normals(vertices, topology.faces)
    counts, corners, floats = _find_all(
        vertices, normals, topology.faces, topology.edges, faces, views.rotation, views.translation, views.lens,
        views.size, views.distance, views.offset, np.array(STEPS_OUT_PX),
    )  # fmt: skip
    kept = np.arange(corners.shape[1])[None, :] < counts[:, None]
    view = np.broadcast_to(np.arange(len(counts), dtype=np.int32)[:, None], kept.shape)[kept]
    corner, values = corners[kept], floats[kept]
    return Rim(
        view, corner, values[:, 0], values[:, 1:4], values[:, 4:7], values[:, 7:9], values[:, 9:11], values[:, 11],
        values[:, 12],
    )  # fmt: skip


@njit(cache=True, fastmath=True)
def _vertex_normals(vertices, faces):
    normals = np.zeros_like(vertices)
    for f in range(len(faces)):
        a, b, c = faces[f]
        ux, uy, uz = vertices[b, 0] - vertices[a, 0], vertices[b, 1] - vertices[a, 1], vertices[b, 2] - vertices[a, 2]
        wx, wy, wz = vertices[c, 0] - vertices[a, 0], vertices[c, 1] - vertices[a, 1], vertices[c, 2] - vertices[a, 2]
        nx, ny, nz = uy * wz - uz * wy, uz * wx - ux * wz, ux * wy - uy * wx
        for v in (a, b, c):
            normals[v, 0] += nx
            normals[v, 1] += ny
            normals[v, 2] += nz
    for v in range(len(normals)):
        length = np.sqrt(normals[v, 0] ** 2 + normals[v, 1] ** 2 + normals[v, 2] ** 2) + 1e-30
        normals[v] /= length
    return normals


@njit(cache=True, fastmath=True)
def _project(point, rotation, translation, lens):
    """Pixel of a world point; not finite behind the camera or past the lens's turning radius."""
    x = rotation[0, 0] * point[0] + rotation[0, 1] * point[1] + rotation[0, 2] * point[2] + translation[0]
    y = rotation[1, 0] * point[0] + rotation[1, 1] * point[1] + rotation[1, 2] * point[2] + translation[1]
    z = rotation[2, 0] * point[0] + rotation[2, 1] * point[1] + rotation[2, 2] * point[2] + translation[2]
    if z <= 1.0:
        return 1e9, 1e9
    x, y = x / z, y / z
    r2 = x * x + y * y
    if r2 > lens[9] * lens[9]:
        return 1e9, 1e9
    radial = 1.0 + r2 * (lens[4] + r2 * (lens[5] + r2 * lens[8]))
    u = x * radial + 2.0 * lens[6] * x * y + lens[7] * (r2 + 2.0 * x * x)
    v = y * radial + lens[6] * (r2 + 2.0 * y * y) + 2.0 * lens[7] * x * y
    return lens[0] * u + lens[2], lens[1] * v + lens[3]


@njit(cache=True, fastmath=True)
def _projection_jacobian(point, rotation, translation, lens):
    """P = d(pixel) / d(world point), 2 x 3."""
    c = rotation @ point + translation
    x, y, iz = c[0] / c[2], c[1] / c[2], 1.0 / c[2]
    r2 = x * x + y * y
    radial = 1.0 + r2 * (lens[4] + r2 * (lens[5] + r2 * lens[8]))
    slope = 2.0 * (lens[4] + r2 * (2.0 * lens[5] + 3.0 * r2 * lens[8]))
    xy = slope * x * y + 2.0 * lens[6] * x + 2.0 * lens[7] * y
    xx = radial + slope * x * x + 2.0 * lens[6] * y + 6.0 * lens[7] * x
    yy = radial + slope * y * y + 6.0 * lens[6] * y + 2.0 * lens[7] * x
    out = np.empty((2, 3))
    for j in range(3):
        dx = (rotation[0, j] - x * rotation[2, j]) * iz
        dy = (rotation[1, j] - y * rotation[2, j]) * iz
        out[0, j] = lens[0] * (xx * dx + xy * dy)
        out[1, j] = lens[1] * (xy * dx + yy * dy)
    return out


@njit(cache=True, fastmath=True)
def _planes(vertices, faces):
    """Normal n of every face and n . a: a centre C is in front of it where n . C > n . a."""
    planes = np.empty((len(faces), 4))
    for f in range(len(faces)):
        a, b, c = faces[f]
        ux, uy, uz = vertices[b, 0] - vertices[a, 0], vertices[b, 1] - vertices[a, 1], vertices[b, 2] - vertices[a, 2]
        wx, wy, wz = vertices[c, 0] - vertices[a, 0], vertices[c, 1] - vertices[a, 1], vertices[c, 2] - vertices[a, 2]
        nx, ny, nz = uy * wz - uz * wy, uz * wx - ux * wz, ux * wy - uy * wx
        planes[f, 0], planes[f, 1], planes[f, 2] = nx, ny, nz
        planes[f, 3] = nx * vertices[a, 0] + ny * vertices[a, 1] + nz * vertices[a, 2]
    return planes


@njit(cache=True, fastmath=True)
def _facing(planes, centre):
    facing = np.empty(len(planes), np.bool_)
    x, y, z = centre
    for f in range(len(planes)):
        facing[f] = planes[f, 0] * x + planes[f, 1] * y + planes[f, 2] * z > planes[f, 3]
    return facing


@njit(cache=True, fastmath=True)
def _sides(vertices, normals, centre):
    """N . (X - C) at every vertex: its zero crossings are the rim."""
    sides = np.empty(len(vertices))
    x, y, z = centre
    for v in range(len(vertices)):
        sides[v] = (
            normals[v, 0] * (vertices[v, 0] - x)
            + normals[v, 1] * (vertices[v, 1] - y)
            + normals[v, 2] * (vertices[v, 2] - z)
        )
    return sides


@njit(cache=True, fastmath=True)
def _chain(vertices, edges, facing, rotation, translation, lens):
    """Image of the edges where the number of layers changes: x0 y0 x1 y1, directed as in the face that looks
    to the camera (against the direction in one that looks away), and by how many."""
    total = 0
    for e in range(len(edges)):
        two = edges[e, 3]
        if two < 0 or facing[edges[e, 2]] != facing[two]:
            total += 1
    chain = np.empty((total, 5))
    i = 0
    for e in range(len(edges)):
        two = edges[e, 3]
        if two < 0 or facing[edges[e, 2]] != facing[two]:
            a, b = edges[e, 0], edges[e, 1]
            if not facing[edges[e, 2]]:
                a, b = b, a
            chain[i, 0], chain[i, 1] = _project(vertices[a], rotation, translation, lens)
            chain[i, 2], chain[i, 3] = _project(vertices[b], rotation, translation, lens)
            chain[i, 4] = 1.0 if two < 0 else 2.0
            i += 1
    return chain


@njit(cache=True, fastmath=True)
def _rows(chain, height):
    """The chain's edges by the image rows that they cross: start of each row in a list of edges."""
    start = np.zeros(height + 1, np.int64)
    for i in range(len(chain)):
        low, high = min(chain[i, 1], chain[i, 3]), max(chain[i, 1], chain[i, 3])
        if high > 1e8 or high < 0 or low >= height:
            continue
        for row in range(max(0, int(np.floor(low))), min(height - 1, int(np.floor(high))) + 1):
            start[row + 1] += 1
    for row in range(height):
        start[row + 1] += start[row]
    members = np.empty(start[height], np.int32)
    fill = start[:-1].copy()
    for i in range(len(chain)):
        low, high = min(chain[i, 1], chain[i, 3]), max(chain[i, 1], chain[i, 3])
        if high > 1e8 or high < 0 or low >= height:
            continue
        for row in range(max(0, int(np.floor(low))), min(height - 1, int(np.floor(high))) + 1):
            members[fill[row]] = i
            fill[row] += 1
    return start, members


@njit(cache=True, fastmath=True)
def _layers(x, y, chain, start, members):
    """Winding number of the chain about a pixel: how many faces lie over it."""
    row = int(np.floor(y))
    if row < 0 or row >= len(start) - 1:
        return 1.0  # outside the image nothing is known; such samples are dropped
    count = 0.0
    for m in range(start[row], start[row + 1]):
        i = members[m]
        y0, y1 = chain[i, 1], chain[i, 3]
        if (y0 <= y) != (y1 <= y):
            crossing = chain[i, 0] + (y - y0) / (y1 - y0) * (chain[i, 2] - chain[i, 0])
            if crossing > x:
                count += chain[i, 4] if y1 > y0 else -chain[i, 4]
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
def _crossings(vertices, normals, sides, faces, speaking, corners, floats, kept_index):
    """Zero crossings of N . (X - C) along the edges of the speaking faces; each edge once. Fills the sample's edge,
    blend, point, normal (in the place of the gradient); returns how many, and the segments that join them."""
    segments = np.empty((corners.shape[0], 2), np.int32)
    count = joined = 0
    ends = np.empty(2, np.int32)
    for s in range(len(speaking)):
        f = speaking[s]
        side0, side1, side2 = sides[faces[f, 0]], sides[faces[f, 1]], sides[faces[f, 2]]
        if (side0 > 0) == (side1 > 0) and (side0 > 0) == (side2 > 0):
            continue
        n = 0
        for j in range(3):
            k = (j + 1) % 3
            a, b = faces[f, j], faces[f, k]
            ga, gb = sides[a], sides[b]
            if (ga > 0) == (gb > 0):
                continue
            if a > b:
                a, b, ga, gb = b, a, gb, ga
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
                t = ga / (ga - gb)
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
def _view(vertices, normals, planes, faces, edges, speaking, rotation, translation, lens, width, height, distance,
          offset, steps, corners, floats):  # fmt: skip
    """One view: fills ``corners`` and ``floats`` with the samples on the outer outline; returns their number."""
    centre = -(rotation.T @ translation)
    facing = _facing(planes, centre)
    sides = _sides(vertices, normals, centre)
    chain = _chain(vertices, edges, facing, rotation, translation, lens)
    start, members = _rows(chain, height)
    kept_index = np.full(len(vertices), -1, np.int32)
    count, joined, segments = _crossings(vertices, normals, sides, faces, speaking, corners, floats, kept_index)
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
        jacobian = _projection_jacobian(floats[s, 1:4], rotation, translation, lens)
        # l = N^T P^+ through the 2 x 2 normal matrix of P's rows.
        normal = floats[s, 4:7].copy()
        g00 = jacobian[0, 0] ** 2 + jacobian[0, 1] ** 2 + jacobian[0, 2] ** 2
        g11 = jacobian[1, 0] ** 2 + jacobian[1, 1] ** 2 + jacobian[1, 2] ** 2
        g01 = jacobian[0, 0] * jacobian[1, 0] + jacobian[0, 1] * jacobian[1, 1] + jacobian[0, 2] * jacobian[1, 2]
        h0 = jacobian[0, 0] * normal[0] + jacobian[0, 1] * normal[1] + jacobian[0, 2] * normal[2]
        h1 = jacobian[1, 0] * normal[0] + jacobian[1, 1] * normal[1] + jacobian[1, 2] * normal[2]
        det = g00 * g11 - g01 * g01
        lx, ly = (g11 * h0 - g01 * h1) / det, (g00 * h1 - g01 * h0) / det
        size = np.sqrt(lx * lx + ly * ly) + 1e-30
        nx, ny = lx / size, ly / size
        covered = False
        for step in steps:
            if _layers(u + step * nx, v + step * ny, chain, start, members) != 0:
                covered = True
        if covered:
            continue
        corners[kept, 0], corners[kept, 1] = corners[s, 0], corners[s, 1]
        for c in range(4):
            floats[kept, c] = floats[s, c]
        for c in range(3):
            floats[kept, 4 + c] = nx * jacobian[0, c] + ny * jacobian[1, c]
        floats[kept, 7], floats[kept, 8], floats[kept, 9], floats[kept, 10] = u, v, nx, ny
        floats[kept, 11] = floats[s, 11]
        floats[kept, 12] = _bilinear(distance, offset, width, height, u, v)
        kept += 1
    return kept


@njit(cache=True, parallel=True, fastmath=True)
def _find_all(vertices, normals, faces, edges, speaking, rotation, translation, lens, size, distance, offset, steps):
    views = len(rotation)
    planes = _planes(vertices, faces)
    counts = np.zeros(views, np.int64)
    corners = np.empty((views, SAMPLES_MOST, 2), np.int32)
    floats = np.empty((views, SAMPLES_MOST, 14))
    for k in prange(views):
        counts[k] = _view(
            vertices, normals, planes, faces, edges, speaking, rotation[k], translation[k], lens[k], size[k, 0],
            size[k, 1], distance, offset[k], steps, corners[k], floats[k],
        )  # fmt: skip
    return counts, corners, floats
