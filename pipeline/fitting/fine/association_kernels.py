"""The compiled loop of ``association``: the closest of the triangles about a few vertices."""

from typing import NamedTuple

import numpy as np

from pipeline.compiled import njit


class Head(NamedTuple):
    """Vertices with their unit normals, triangles, and by vertex where its triangles begin, and those."""

    vertices: np.ndarray
    vertex_normals: np.ndarray
    faces: np.ndarray
    start: np.ndarray
    member: np.ndarray


@njit(cache=True, nogil=True, error_model="numpy")
def closest_triangles(first, last, points, normals, near, head, least_agreement, triangle, blend, square):
    """For points ``first`` to ``last``: of the triangles at the vertices ``near`` whose side agrees with the point's
    normal, the closest one, its barycentric weights, and the squared distance; triangle -1 where none agrees.

    Point to triangle after C. Ericson, *Real-Time Collision Detection* (2005), section 5.1.5.
    """
    vertices, vertex_normals, faces, start, member = head
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
            if agreement < least_agreement:
                continue
            for m in range(start[v], start[v + 1]):
                t = member[m]
                a, b, d = faces[t]
                abx, aby, abz = (
                    vertices[b, 0] - vertices[a, 0], vertices[b, 1] - vertices[a, 1], vertices[b, 2] - vertices[a, 2]
                )  # fmt: skip
                acx, acy, acz = (
                    vertices[d, 0] - vertices[a, 0], vertices[d, 1] - vertices[a, 1], vertices[d, 2] - vertices[a, 2]
                )  # fmt: skip
                apx, apy, apz = x - vertices[a, 0], y - vertices[a, 1], z - vertices[a, 2]
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
                e = ex * ex + ey * ey + ez * ez
                if e < best:
                    best = e
                    triangle[p] = t
                    blend[p, 0], blend[p, 1], blend[p, 2] = 1.0 - w1 - w2, w1, w2
        square[p] = best
