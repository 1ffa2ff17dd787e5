"""Decimates meshes by quadric error (Garland and Heckbert, *Surface simplification using quadric error metrics*,
SIGGRAPH 1997)."""

import heapq
from collections.abc import Sequence

import numpy as np
from jaxtyping import Bool, Float, Int

from pipeline.head_model.subdivision import boundary_vertices
from rig.mesh import face_normals


class _Collapser:
    """Holds the state of one decimation: triangles around each vertex, quadrics, and a heap of half-edge collapses."""

    # Lists of floats, not arrays: on vectors of three numpy's overhead is ten times the arithmetic.
    def __init__(
        self,
        vertices: np.ndarray,
        faces: np.ndarray,
        importance: np.ndarray,
        fixed: np.ndarray,
        chart: np.ndarray | None,
    ) -> None:
        self.places: list[list[float]] = vertices.tolist()
        self.chart: list[list[float]] | None = None if chart is None else chart.tolist()
        self.fixed: list[bool] = fixed.tolist()
        self.faces: dict[int, tuple[int, int, int]] = {k: (int(a), int(b), int(c)) for k, (a, b, c) in enumerate(faces)}
        self.at: list[set[int]] = [set() for _ in vertices]
        for k, face in self.faces.items():
            for v in face:
                self.at[v].add(k)
        self.border: list[bool] = boundary_vertices(faces, len(vertices)).tolist()
        self.quadric: list[list[float]] = (_quadrics(vertices, faces) * importance[:, None]).tolist()
        self.stamp = [0] * len(vertices)
        self.heap: list[tuple[float, int, int, int, int]] = []
        for v in range(len(vertices)):
            self.push_from(v)

    def ring(self, v: int) -> set[int]:
        return {w for k in self.at[v] for w in self.faces[k]} - {v}

    def push_from(self, v: int) -> None:
        """Adds the collapses of vertex v into each of its neighbours to the heap."""
        if self.fixed[v]:
            return
        for u in self.ring(v):
            heapq.heappush(self.heap, (self.cost(v, u), v, u, self.stamp[v], self.stamp[u]))

    def cost(self, v: int, u: int) -> float:
        x, y, z = self.places[u]
        xx, xy, xz, yy, yz, zz, xd, yd, zd, dd = (p + q for p, q in zip(self.quadric[v], self.quadric[u], strict=True))
        flat = x * x * xx + y * y * yy + z * z * zz + dd
        flat += 2 * (x * y * xy + x * z * xz + y * z * yz + x * xd + y * yd + z * zd)
        a, b, c = self.places[v]
        step = (x - a) ** 2 + (y - b) ** 2 + (z - c) ** 2
        return flat + 1e-3 * step  # on flat ground prefer short edges: keeps triangles round

    def allowed(self, v: int, u: int) -> bool:
        shared = self.at[v] & self.at[u]
        if self.border[v] and not (self.border[u] and len(shared) == 1):
            return False
        if len(self.ring(v) & self.ring(u)) != len(shared):  # link condition: stays a manifold
            return False
        return all(self._survives(k, v, u) for k in self.at[v] - shared)

    def _survives(self, k: int, v: int, u: int) -> bool:
        """Returns whether triangle k neither folds (in space or in the chart) nor becomes a sliver if its corner v
        moves to u."""
        corners, moved = self.faces[k], [u if w == v else w for w in self.faces[k]]
        if self.chart is not None and _turn(self.chart, corners) * _turn(self.chart, moved) <= 0:
            return False
        before, after = [self.places[w] for w in corners], [self.places[w] for w in moved]
        n0, n1 = _cross(before), _cross(after)
        longest = max(_squared(after[0], after[1]), _squared(after[1], after[2]), _squared(after[2], after[0]))
        length = (_inner(n0, n0) * _inner(n1, n1)) ** 0.5
        return _inner(n0, n1) > 0.3 * length and _inner(n1, n1) ** 0.5 > 0.12 * longest

    def collapse(self, v: int, u: int) -> None:
        for k in self.at[v] & self.at[u]:
            for w in self.faces.pop(k):
                self.at[w].discard(k)
        for k in list(self.at[v]):
            a, b, c = (u if w == v else w for w in self.faces[k])
            self.faces[k] = (a, b, c)
            self.at[u].add(k)
        self.at[v].clear()
        self.quadric[u] = [p + q for p, q in zip(self.quadric[u], self.quadric[v], strict=True)]
        self.stamp[v] = -1
        self.stamp[u] += 1  # only u's quadric has changed; what else went stale is judged by allowed()
        for w in self.ring(u) | {u}:
            self.push_from(w)


def _cross(corners: list[list[float]]) -> tuple[float, float, float]:
    (ax, ay, az), (bx, by, bz), (cx, cy, cz) = corners
    ux, uy, uz, vx, vy, vz = bx - ax, by - ay, bz - az, cx - ax, cy - ay, cz - az
    return uy * vz - uz * vy, uz * vx - ux * vz, ux * vy - uy * vx


def _inner(a: tuple[float, float, float], b: tuple[float, float, float]) -> float:
    return a[0] * b[0] + a[1] * b[1] + a[2] * b[2]


def _squared(a: list[float], b: list[float]) -> float:
    return (a[0] - b[0]) ** 2 + (a[1] - b[1]) ** 2 + (a[2] - b[2]) ** 2


def _turn(chart: list[list[float]], corners: Sequence[int]) -> float:
    """Returns twice the signed area of a triangle in the chart (texture coordinates)."""
    (ax, ay), (bx, by), (cx, cy) = (chart[w] for w in corners)
    return (bx - ax) * (cy - ay) - (by - ay) * (cx - ax)


def _quadrics(vertices: Float[np.ndarray, "V 3"], faces: Int[np.ndarray, "F 3"]) -> Float[np.ndarray, "V 10"]:
    """Returns, for each vertex, the quadric that sums its squared plane distances weighted by area: xx xy xz yy yz zz
    xd yd zd dd."""
    normals = face_normals(vertices, faces)
    area = np.linalg.norm(normals, axis=1)
    x, y, z = (normals / np.maximum(area, 1e-12)[:, None]).T
    d = -(np.stack([x, y, z], 1) * vertices[faces[:, 0]]).sum(1)
    terms = np.stack([x * x, x * y, x * z, y * y, y * z, z * z, x * d, y * d, z * d, d * d], 1) * area[:, None] / 2
    total = np.zeros((len(vertices), 10))
    for k in range(3):
        np.add.at(total, faces[:, k], terms)
    return total


def decimate(
    vertices: Float[np.ndarray, "V 3"],
    faces: Int[np.ndarray, "F 3"],
    targets: tuple[int, ...],
    *,
    importance: Float[np.ndarray, " V"],
    fixed: Bool[np.ndarray, " V"],
    chart: Float[np.ndarray, "V 2"] | None = None,
) -> list[tuple[Int[np.ndarray, " _"], Int[np.ndarray, "_ 3"]]]:
    """Reduces a mesh to each of the decreasing numbers of triangles in ``targets``. Returns, for each target, the
    remaining vertices (indices, ascending) and the triangles between them.

    ``importance`` multiplies the error of a vertex: where it is high the mesh stays denser. All ``fixed`` vertices
    remain. With a ``chart`` (texture coordinates) no triangle turns over in it. A result has more triangles than its
    target if every further collapse would fold the surface, leave a sliver, or break the manifold.
    """
    state = _Collapser(vertices, faces, importance, fixed, chart)
    out = []
    for target in targets:
        while len(state.faces) > target and state.heap:
            _, v, u, stamp_v, stamp_u = heapq.heappop(state.heap)
            if state.stamp[v] == stamp_v and state.stamp[u] == stamp_u and state.allowed(v, u):
                state.collapse(v, u)
        left = np.array(list(state.faces.values()), np.int32)
        kept, local = np.unique(left, return_inverse=True)
        out.append((kept.astype(np.int32), local.reshape(-1, 3).astype(np.int32)))
    return out
