"""Contains the compiled loops that find flipped, folded and intersecting triangles of a mesh.

Triangles are sorted into cubic cells by the middles of their bounding boxes. A cell is as wide as the widest box, so
intersecting triangles lie in neighbouring cells. Two triangles cross if an edge of one passes through the other;
triangles that only touch do not cross.
"""

import numpy as np

from pipeline.geometry.nearest_kernels import COLUMNS, columns_about
from rig.jit import njit


@njit(cache=True, nogil=True)
def triangle_boxes(vertices: np.ndarray, faces: np.ndarray) -> np.ndarray:
    """Returns the lowest and the highest corner of each triangle's bounding box, (f, 6)."""
    boxes = np.empty((len(faces), 6))
    for f in range(len(faces)):
        for axis in range(3):
            a, b, c = vertices[faces[f, 0], axis], vertices[faces[f, 1], axis], vertices[faces[f, 2], axis]
            boxes[f, axis], boxes[f, 3 + axis] = min(min(a, b), c), max(max(a, b), c)
    return boxes


@njit(cache=True, nogil=True)
def any_corner(vertex: np.ndarray, faces: np.ndarray) -> np.ndarray:
    """Returns a mask (f) of the triangles with a corner among the marked vertices ``vertex`` (v)."""
    found = np.empty(len(faces), np.bool_)
    for f in range(len(faces)):
        found[f] = vertex[faces[f, 0]] | vertex[faces[f, 1]] | vertex[faces[f, 2]]
    return found


@njit(cache=True, nogil=True)
def turned_and_folded(
    vertices: np.ndarray, faces: np.ndarray, pairs: np.ndarray, near: np.ndarray, least_cosine: float
) -> tuple[np.ndarray, np.ndarray]:
    """Returns a mask (f) of triangles that face against the mean normal of their corners. Also returns a mask (e) of
    triangle ``pairs`` (e, 2) whose normals have a cosine below ``least_cosine``. Only triangles ``near`` (f) are
    tested."""
    normals, means = np.zeros((len(faces), 3)), np.zeros((len(vertices), 3))
    for f in range(len(faces)):
        if near[f]:
            a, b, c = vertices[faces[f, 0]], vertices[faces[f, 1]], vertices[faces[f, 2]]
            for x in range(3):
                y, z = (x + 1) % 3, (x + 2) % 3
                normals[f, x] = (b[y] - a[y]) * (c[z] - a[z]) - (b[z] - a[z]) * (c[y] - a[y])
                for corner in range(3):
                    means[faces[f, corner], x] += normals[f, x]
    turned, folded = np.zeros(len(faces), np.bool_), np.zeros(len(pairs), np.bool_)
    for f in range(len(faces)):
        if near[f]:
            along = 0.0
            for corner in range(3):
                mean = means[faces[f, corner]]
                along += _dot(mean, normals[f]) / max(np.sqrt(_dot(mean, mean)), 1e-12)
            turned[f] = along <= 0.0
    for e in range(len(pairs)):
        if near[pairs[e, 0]] and near[pairs[e, 1]]:
            one, other = normals[pairs[e, 0]], normals[pairs[e, 1]]
            sizes = np.sqrt(_dot(one, one) * _dot(other, other))
            folded[e] = _dot(one, other) < least_cosine * max(sizes, 1e-24)
    return turned, folded


@njit(cache=True, nogil=True, inline="always")
def _dot(a: np.ndarray, b: np.ndarray) -> float:
    return a[0] * b[0] + a[1] * b[1] + a[2] * b[2]


@njit(cache=True, nogil=True)
def beside_active(boxes: np.ndarray, active: np.ndarray) -> np.ndarray:
    """Returns a mask (f) of triangles in or beside a cell that contains the middle of an ``active`` triangle."""
    wide, low, high = 1e-9, np.full(3, np.inf), np.full(3, -np.inf)
    for f in range(len(boxes)):
        for axis in range(3):
            wide = max(wide, boxes[f, 3 + axis] - boxes[f, axis])
            middle = 0.5 * (boxes[f, axis] + boxes[f, 3 + axis])
            low[axis], high[axis] = min(low[axis], middle), max(high[axis], middle)
    cells, near = np.empty((len(boxes), 3), np.int64), np.empty(len(boxes), np.bool_)
    nx, ny, nz = ((high - low) / wide).astype(np.int64) + 3
    taken = np.zeros((nx, ny, nz), np.bool_)
    for f in range(len(boxes)):
        for axis in range(3):
            cells[f, axis] = int((0.5 * (boxes[f, axis] + boxes[f, 3 + axis]) - low[axis]) / wide) + 1
        if active[f]:
            x, y, z = cells[f]
            taken[x - 1 : x + 2, y - 1 : y + 2, z - 1 : z + 2] = True
    for f in range(len(boxes)):
        near[f] = taken[cells[f, 0], cells[f, 1], cells[f, 2]]
    return near


@njit(cache=True, nogil=True)
def crossing_triangles(
    vertices: np.ndarray,
    faces: np.ndarray,
    boxes: np.ndarray,
    order: np.ndarray,
    keys: np.ndarray,
    spans: np.ndarray,
    active: np.ndarray,
    crossing: np.ndarray,
    first: int,
    last: int,
) -> None:
    """Marks triangles that cross another triangle in ``crossing`` (f), in place. The function tests pairs with an
    ``active`` triangle at the positions ``first`` to ``last`` of ``order``. Threads may run at the same time.

    ``order``, sorted ``keys`` and ``spans`` (the number of cells) are as in ``cells.Cells``; ``boxes`` (f, 6) is in the
    sorted order.
    """
    ranges, cell = np.empty((COLUMNS, 2), np.int64), -1
    for position in range(first, last):
        f = order[position]
        if not active[f]:
            continue
        if keys[position] != cell:
            cell = keys[position]
            columns_about(cell, keys, spans, ranges)
        for column in range(COLUMNS):
            for at in range(ranges[column, 0], ranges[column, 1]):
                if at <= position and active[order[at]]:  # the pair is looked at from the other side
                    continue
                if not _boxes_meet(boxes, np.uint64(position), np.uint64(at)):
                    continue
                g = order[at]
                if _cross(vertices, faces[f], faces[g]):
                    crossing[f] = crossing[g] = True


@njit(cache=True, nogil=True, inline="always")
def _boxes_meet(boxes: np.ndarray, f: int, g: int) -> bool:
    apart = False
    for axis in range(3):  # without branches: most boxes are apart, and nothing foretells in which axis
        apart |= (boxes[f, axis] > boxes[g, 3 + axis]) | (boxes[g, axis] > boxes[f, 3 + axis])
    return not apart


@njit(cache=True, nogil=True)
def _cross(vertices: np.ndarray, f: np.ndarray, g: np.ndarray) -> bool:
    shared = 0
    for a in range(3):
        for b in range(3):
            shared += f[a] == g[b]
    if shared >= 2:  # neighbours over an edge
        return False
    if _beside(vertices, f, g) or _beside(vertices, g, f):  # most pairs whose boxes meet
        return False
    for k in range(3):
        if _pierces(vertices, f[k], f[(k + 1) % 3], g) or _pierces(vertices, g[k], g[(k + 1) % 3], f):
            return True
    return False


@njit(cache=True, nogil=True, inline="always")
def _beside(vertices: np.ndarray, f: np.ndarray, g: np.ndarray) -> bool:
    """Returns True if triangle ``g`` lies on one side of the plane of triangle ``f`` or only touches it."""
    one = _side(vertices, f[0], f[1], f[2], g[0])
    two = _side(vertices, f[0], f[1], f[2], g[1])
    three = _side(vertices, f[0], f[1], f[2], g[2])
    return (one >= 0 and two >= 0 and three >= 0) or (one <= 0 and two <= 0 and three <= 0)


@njit(cache=True, nogil=True)
def _pierces(vertices: np.ndarray, p: int, q: int, face: np.ndarray) -> bool:
    a, b, c = face[0], face[1], face[2]
    if p in (a, b, c) or q in (a, b, c):  # an edge that ends in a corner does not go through the face
        return False
    if _side(vertices, a, b, c, p) * _side(vertices, a, b, c, q) >= 0:
        return False
    one, two, three = _side(vertices, p, q, a, b), _side(vertices, p, q, b, c), _side(vertices, p, q, c, a)
    return (one > 0 and two > 0 and three > 0) or (one < 0 and two < 0 and three < 0)


@njit(cache=True, nogil=True, inline="always")
def _side(v: np.ndarray, a: int, b: int, c: int, d: int) -> float:
    """Returns six times the signed volume of a tetrahedron."""
    bx, by, bz = v[b, 0] - v[a, 0], v[b, 1] - v[a, 1], v[b, 2] - v[a, 2]
    cx, cy, cz = v[c, 0] - v[a, 0], v[c, 1] - v[a, 1], v[c, 2] - v[a, 2]
    dx, dy, dz = v[d, 0] - v[a, 0], v[d, 1] - v[a, 1], v[d, 2] - v[a, 2]
    return bx * (cy * dz - cz * dy) + by * (cz * dx - cx * dz) + bz * (cx * dy - cy * dx)
