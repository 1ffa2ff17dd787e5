"""Triangle surfaces as the head models need them: edges, borders, Loop subdivision as a sparse operator, decimation.

Subdivision: C. Loop, *Smooth Subdivision Surfaces Based on Triangles* (1987), interior weights after Warren, cubic
B-spline rule on open borders. It is linear in the vertices, so one operator refines mean and modes alike (section 3.1).
Decimation: half-edge collapses ordered by Garland and Heckbert's quadric error (1997). Half-edge collapses keep a
subset of the vertices where they are, so that a decimated level is a choice of rows of the same operator.
"""

import heapq

import numpy as np
import scipy.sparse as sparse
from jaxtyping import Bool, Float, Int

from rig.errors import EigenheadError
from rig.mesh import boundary_edges, face_normals


class NotAManifold(EigenheadError):
    """A surface on which an edge has more than two triangles, or two that disagree about the outside."""

    def __init__(self, count: int, what: str) -> None:
        super().__init__(f"{count} edges {what}; repair the mesh (one consistently wound surface) and try again")


def row_count(operator: sparse.csr_array) -> int:
    """Rows of a sparse operator."""
    shape = operator.shape
    assert shape is not None
    return int(shape[0])


def edges_of(
    faces: Int[np.ndarray, "F 3"],
) -> tuple[Int[np.ndarray, "E 2"], Int[np.ndarray, "F 3"], Int[np.ndarray, " E"]]:
    """Unique edges (sorted pairs), the edge opposite each corner of each face, and the faces at each edge (a count)."""
    directed = np.concatenate([faces[:, [1, 2]], faces[:, [2, 0]], faces[:, [0, 1]]]).astype(np.int64)
    low, high = directed.min(1), directed.max(1)
    base = int(faces.max()) + 1
    keys, inverse, counts = np.unique(low * base + high, return_inverse=True, return_counts=True)
    return (
        np.stack([keys // base, keys % base], 1).astype(np.int32),
        inverse.reshape(3, -1).T.astype(np.int32),
        counts.astype(np.int32),
    )


def check_manifold(faces: Int[np.ndarray, "F 3"]) -> None:
    """Raises NotAManifold where an edge has over two faces, or two neighbours wind against each other."""
    _, _, counts = edges_of(faces)
    if (counts > 2).any():
        raise NotAManifold(int((counts > 2).sum()), "are shared by more than two triangles")
    directed = np.concatenate([faces[:, [0, 1]], faces[:, [1, 2]], faces[:, [2, 0]]]).astype(np.int64)
    _, repeats = np.unique(directed[:, 0] * (int(faces.max()) + 1) + directed[:, 1], return_counts=True)
    if (repeats > 1).any():
        raise NotAManifold(int((repeats > 1).sum()), "run the same way in both of their triangles")


def boundary_vertices(faces: Int[np.ndarray, "F 3"], count: int) -> Bool[np.ndarray, " V"]:
    """Vertices on an open edge of the mesh."""
    edges, _, uses = edges_of(faces)
    flags = np.zeros(count, bool)
    flags[edges[uses == 1].ravel()] = True
    return flags


def vertex_areas(vertices: Float[np.ndarray, "V 3"], faces: Int[np.ndarray, "F 3"]) -> Float[np.ndarray, " V"]:
    """A third of the area of the triangles at each vertex, mm²."""
    area = np.linalg.norm(face_normals(vertices, faces), axis=1) / 6
    return np.bincount(faces.ravel(), np.repeat(area, 3), len(vertices))


def boundary_loops(faces: Int[np.ndarray, "F 3"]) -> list[list[int]]:
    """Closed loops of open edges, each in the direction in which its triangles run. Raises NotAManifold."""
    after: dict[int, int] = {}
    rim = boundary_edges(faces)
    for a, b in rim.tolist():
        after[a] = b
    if len(after) < len(rim):
        raise NotAManifold(len(rim) - len(after), "make a border touch itself at a vertex")
    loops = []
    while after:
        first, here = after.popitem()
        loop = [first]
        while here != first:
            loop.append(here)
            here = after.pop(here)
        loops.append(loop)
    return loops


def close_loop(vertices: Float[np.ndarray, "V 3"], loop: list[int]) -> Int[np.ndarray, "T 3"]:
    """A strip of triangles across a long opening such as a mouth or an eye, from its left end to its right one.

    No vertex is added. The strip continues the surface if ``loop`` runs as ``boundary_loops`` gives it.
    """
    x = vertices[loop, 0]
    start, end = int(x.argmin()), int(x.argmax())
    ring = loop[start:] + loop[:start]
    turn = (end - start) % len(loop)
    one, other = ring[: turn + 1], [ring[0], *ring[: turn - 1 : -1]]
    out, i, j = [], 0, 0
    while i < len(one) - 1 or j < len(other) - 1:
        # step on the side that is behind; both halves end in the far corner
        ahead = j == len(other) - 1 or (i < len(one) - 1 and vertices[one[i + 1], 0] <= vertices[other[j + 1], 0])
        if ahead:
            out.append([one[i + 1], one[i], other[j]])
            i += 1
        else:
            out.append([other[j], other[j + 1], one[i]])
            j += 1
    return np.array([t for t in out if len(set(t)) == 3], np.int32).reshape(-1, 3)


def subdivision(faces: Int[np.ndarray, "F 3"], count: int) -> tuple[sparse.csr_array, Int[np.ndarray, "F4 3"]]:
    """One Loop step: the operator ((V + E) x V) and the refined faces. Old vertices come first."""
    edges, opposite_edge, uses = edges_of(faces)
    moved = _even_rule(edges, uses, count)
    fresh = _odd_rule(faces, edges, opposite_edge, uses, count)
    a, b, c = faces.T
    ea, eb, ec = (count + opposite_edge).T  # the new vertex opposite a, b, c
    refined = np.stack([[a, ec, eb], [b, ea, ec], [c, eb, ea], [ea, eb, ec]]).transpose(2, 0, 1).reshape(-1, 3)
    return sparse.csr_array(sparse.vstack([moved, fresh])), refined.astype(np.int32)


def _even_rule(edges: Int[np.ndarray, "E 2"], uses: Int[np.ndarray, " E"], count: int) -> sparse.csr_array:
    both = np.concatenate([edges, edges[:, ::-1]])
    on_border = np.zeros(count, bool)
    on_border[edges[uses == 1].ravel()] = True
    valence = np.bincount(both[:, 0], minlength=count)
    beta = np.where(valence == 3, 3 / 16, 3 / (8 * np.maximum(valence, 1)))  # Warren's weights
    border_edge = np.concatenate([uses == 1, uses == 1])
    source = both[:, 0]
    keep = ~on_border[source] | border_edge
    weight = np.where(on_border[source], 1 / 8, beta[source])
    centre = np.where(on_border, 3 / 4, 1 - valence * beta)
    rows = np.concatenate([source[keep], np.arange(count)])
    columns = np.concatenate([both[keep, 1], np.arange(count)])
    return sparse.csr_array((np.concatenate([weight[keep], centre]), (rows, columns)), shape=(count, count))


def _odd_rule(
    faces: Int[np.ndarray, "F 3"],
    edges: Int[np.ndarray, "E 2"],
    opposite_edge: Int[np.ndarray, "F 3"],
    uses: Int[np.ndarray, " E"],
    count: int,
) -> sparse.csr_array:
    ends = np.where(uses == 1, 1 / 2, 3 / 8)
    index = np.arange(len(edges))
    across = opposite_edge.ravel()
    inner = uses[across] == 2
    rows = np.concatenate([index, index, across[inner]])
    columns = np.concatenate([edges[:, 0], edges[:, 1], faces.ravel()[inner]])
    values = np.concatenate([ends, ends, np.full(int(inner.sum()), 1 / 8)])
    return sparse.csr_array((values, (rows, columns)), shape=(len(edges), count))


def refine(faces: Int[np.ndarray, "F 3"], count: int, steps: int) -> tuple[sparse.csr_array, Int[np.ndarray, "G 3"]]:
    """``steps`` Loop steps as one operator (identity for 0)."""
    operator: sparse.csr_array = sparse.csr_array(sparse.identity(count, format="csr"))
    for _ in range(steps):
        step, faces = subdivision(faces, row_count(operator))
        operator = sparse.csr_array(step @ operator)
    return operator, faces.astype(np.int32)


class _Collapser:
    """State of one decimation: triangles by vertex, quadrics, and a lazy heap of half-edge collapses."""

    # Lists of floats, not arrays: on vectors of three numpy's overhead is ten times the arithmetic.
    def __init__(self, vertices: np.ndarray, faces: np.ndarray, importance: np.ndarray, fixed: np.ndarray) -> None:
        self.places: list[list[float]] = vertices.tolist()
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
        """Offer the collapses of v into each neighbour."""
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
        """The triangle neither folds over nor becomes a sliver when its corner v moves to u."""
        before = [self.places[w] for w in self.faces[k]]
        after = [self.places[u if w == v else w] for w in self.faces[k]]
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


def _quadrics(vertices: Float[np.ndarray, "V 3"], faces: Int[np.ndarray, "F 3"]) -> Float[np.ndarray, "V 10"]:
    """Sum of squared plane distances per vertex, weighted by area: xx xy xz yy yz zz xd yd zd dd."""
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
) -> list[tuple[Int[np.ndarray, " K"], Int[np.ndarray, "G 3"]]]:
    """One level per target face count (falling): kept vertex indices, ascending, and faces among them.

    ``importance`` multiplies the error of a vertex (denser where it is high), ``fixed`` vertices are all kept. A level
    may end with more faces than asked where no collapse is left that keeps a manifold without folds or slivers.
    """
    state = _Collapser(vertices, faces, importance, fixed)
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
