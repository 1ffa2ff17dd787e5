"""Holds the compiled loops of ``pipeline.geometry.surface_index``, and a search among triangles of nearby vertices."""

from typing import NamedTuple

import numpy as np

from rig.jit import njit


class FannedMesh(NamedTuple):
    """Holds a triangle mesh with unit vertex normals. The triangles around vertex v are ``member[start[v]:start[v +
    1]]``."""

    vertices: np.ndarray
    vertex_normals: np.ndarray
    faces: np.ndarray
    start: np.ndarray
    member: np.ndarray


@njit(cache=True, nogil=True, error_model="numpy", inline="always")
def closest_on_triangle(x, y, z, one, other, third):
    """Returns the closest point of a triangle to (x, y, z), as barycentric weights of the second and third corner, and
    the squared distance. The method is from C. Ericson, *Real-Time Collision Detection* (2005), section 5.1.5."""
    abx, aby, abz = other[0] - one[0], other[1] - one[1], other[2] - one[2]
    acx, acy, acz = third[0] - one[0], third[1] - one[1], third[2] - one[2]
    apx, apy, apz = x - one[0], y - one[1], z - one[2]
    d1, d2 = abx * apx + aby * apy + abz * apz, acx * apx + acy * apy + acz * apz
    bb = abx * abx + aby * aby + abz * abz
    bc = abx * acx + aby * acy + abz * acz
    cc = acx * acx + acy * acy + acz * acz
    d3, d4 = d1 - bb, d2 - bc  # of the point seen from b
    d5, d6 = d1 - bc, d2 - cc  # and from c
    vb, vc, va = d5 * d2 - d1 * d6, d1 * d4 - d3 * d2, d3 * d6 - d5 * d4
    if d1 <= 0.0 and d2 <= 0.0:
        w1, w2 = 0.0, 0.0
    elif d3 >= 0.0 and d4 <= d3:
        w1, w2 = 1.0, 0.0
    elif vc <= 0.0 and d1 >= 0.0 and d3 <= 0.0:
        w1, w2 = d1 / (d1 - d3), 0.0
    elif d6 >= 0.0 and d5 <= d6:
        w1, w2 = 0.0, 1.0
    elif vb <= 0.0 and d2 >= 0.0 and d6 <= 0.0:
        w1, w2 = 0.0, d2 / (d2 - d6)
    elif va <= 0.0 and d4 - d3 >= 0.0 and d5 - d6 >= 0.0:
        w2 = (d4 - d3) / ((d4 - d3) + (d5 - d6))
        w1 = 1.0 - w2
    else:
        total = va + vb + vc
        w1, w2 = vb / total, vc / total
    ex = apx - w1 * abx - w2 * acx
    ey = apy - w1 * aby - w2 * acy
    ez = apz - w1 * abz - w2 * acz
    return w1, w2, ex * ex + ey * ey + ez * ez


@njit(cache=True, nogil=True, error_model="numpy")
def closest_at_vertices(first, last, points, normals, near, surface, min_agreement, triangle, blend, square):
    """Finds the closest triangle for points ``first`` to ``last`` among the triangles around the vertices ``near`` (n,
    candidates). Vertices are skipped if the cosine between their normal and the point's normal is below
    ``min_agreement``.

    Fills ``triangle`` (n; -1 if all vertices were skipped), its barycentric weights ``blend`` (n, 3), and the
    ``square`` of the distance (n). A row of ``near`` ends at the first entry that equals the number of vertices."""
    vertices, vertex_normals, faces, start, member = surface
    for p in range(first, last):
        triangle[p] = -1
        best = 1e30
        x, y, z = points[p]
        for c in range(near.shape[1]):
            v = near[p, c]
            if v == len(vertices):  # no more within reach
                break
            agreement = (
                normals[p, 0] * vertex_normals[v, 0]
                + normals[p, 1] * vertex_normals[v, 1]
                + normals[p, 2] * vertex_normals[v, 2]
            )
            if agreement < min_agreement:
                continue
            for m in range(start[v], start[v + 1]):
                t = member[m]
                w1, w2, e = closest_on_triangle(
                    x, y, z, vertices[faces[t, 0]], vertices[faces[t, 1]], vertices[faces[t, 2]]
                )
                if e < best:
                    best = e
                    triangle[p] = t
                    blend[p, 0], blend[p, 1], blend[p, 2] = 1.0 - w1 - w2, w1, w2
        square[p] = best


@njit(cache=True, nogil=True, error_model="numpy")
def closest_of_candidates(first, last, points, candidates, corners, facing, facing_mm, triangle, weights):
    """Finds the closest of the triangles ``candidates`` (n, k) for points ``first`` to ``last``. Fills ``triangle`` (n)
    and the barycentric ``weights`` of the closest point (n, 3).

    If ``facing`` (n, 3; unit normals of the points) is not empty, a triangle that faces the opposite way counts as
    ``facing_mm`` farther away, and a perpendicular one as half of this. ``corners`` (t, 3, 3) are the corner positions
    of all triangles."""
    for p in range(first, last):
        least = np.inf
        x, y, z = points[p]
        for c in range(candidates.shape[1]):
            t = candidates[p, c]
            w1, w2, square = closest_on_triangle(x, y, z, corners[t, 0], corners[t, 1], corners[t, 2])
            cost = np.sqrt(square)
            if len(facing):
                cost += 0.5 * facing_mm * (1.0 - _cosine(corners[t], facing[p]))
            if cost < least:
                least = cost
                triangle[p] = t
                weights[p, 0], weights[p, 1], weights[p, 2] = 1.0 - w1 - w2, w1, w2


@njit(cache=True, nogil=True, error_model="numpy", inline="always")
def _cosine(corners, direction):
    """Returns the cosine between a triangle's normal and a unit vector; 0 for a triangle without area."""
    abx, aby, abz = corners[1, 0] - corners[0, 0], corners[1, 1] - corners[0, 1], corners[1, 2] - corners[0, 2]
    acx, acy, acz = corners[2, 0] - corners[0, 0], corners[2, 1] - corners[0, 1], corners[2, 2] - corners[0, 2]
    nx, ny, nz = aby * acz - abz * acy, abz * acx - abx * acz, abx * acy - aby * acx
    along = nx * direction[0] + ny * direction[1] + nz * direction[2]
    return along / max(np.sqrt(nx * nx + ny * ny + nz * nz), 1e-18)


@njit(cache=True, nogil=True)
def sort_corners(faces: np.ndarray, count: int) -> tuple[np.ndarray, np.ndarray]:
    """Sorts the corners of faces (f, 3) by vertex (a counting sort). The corners of vertex v are
    ``corner[start[v]:start[v + 1]]``, in ascending order; corner 3 f + k is the k-th corner of face f."""
    start, corner = np.zeros(count + 1, np.int64), np.empty(faces.size, np.int64)
    for f in range(len(faces)):
        for k in range(3):
            start[faces[f, k] + 1] += 1
    for v in range(count):
        start[v + 1] += start[v]
    taken = start[:-1].copy()
    for f in range(len(faces)):
        for k in range(3):
            v = faces[f, k]
            corner[taken[v]] = 3 * f + k
            taken[v] += 1
    return start, corner


@njit(cache=True, nogil=True, error_model="numpy")
def cosines_towards(place: np.ndarray, points: np.ndarray, normals: np.ndarray) -> np.ndarray:
    """Returns the cosine between the unit normal (n, 3) of each of the points (n, 3) and the direction to one place."""
    cosine = np.empty(len(points))
    for n in range(len(points)):
        x, y, z = place[0] - points[n, 0], place[1] - points[n, 1], place[2] - points[n, 2]
        along = x * normals[n, 0] + y * normals[n, 1] + z * normals[n, 2]
        cosine[n] = along / np.sqrt(x * x + y * y + z * z)
    return cosine
