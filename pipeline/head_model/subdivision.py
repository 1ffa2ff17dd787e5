"""Provides operations on the triangle meshes of head models: edges, borders, and Loop subdivision as a sparse operator.

Subdivision follows C. Loop, *Smooth Subdivision Surfaces Based on Triangles* (1987), with Warren's interior weights and
the cubic B-spline rule on open borders. Subdivision is linear in the vertices, so one operator refines mean and modes
(the paper's section 3.1). Decimation uses half-edge collapses ordered by Garland and Heckbert's quadric error (1997).
Half-edge collapses do not move the remaining vertices, so a decimated mesh is a selection of the operator's rows."""

from collections.abc import Mapping

import numpy as np
import scipy.sparse as sparse
from jaxtyping import Bool, Float, Int

from rig.errors import EigenheadError
from rig.mesh import boundary_edges, edges_of, face_normals

OPENINGS = 4  # borders of a head whose eyes and mouth are open: these and the neck
MAX_CLOSING = 400  # triangles that close eyes and mouth: 192 of the default model, 152 of ICT-FaceKit


class NotAManifold(EigenheadError):
    """Reports a surface on which an edge has more than two triangles, or two triangles with opposite orientation."""

    def __init__(self, count: int, what: str) -> None:
        super().__init__(f"{count} edges {what}; repair the mesh (one consistently wound surface) and try again")


def row_count(operator: sparse.csr_array) -> int:
    """Returns the number of rows of a sparse matrix."""
    shape = operator.shape
    assert shape is not None
    return int(shape[0])


def check_manifold(faces: Int[np.ndarray, "F 3"]) -> None:
    """Raises NotAManifold if an edge has more than two triangles, or if two neighbouring triangles have opposite
    orientation."""
    _, _, counts = edges_of(faces)
    if (counts > 2).any():
        raise NotAManifold(int((counts > 2).sum()), "are shared by more than two triangles")
    directed = np.concatenate([faces[:, [0, 1]], faces[:, [1, 2]], faces[:, [2, 0]]]).astype(np.int64)
    _, repeats = np.unique(directed[:, 0] * (int(faces.max()) + 1) + directed[:, 1], return_counts=True)
    if (repeats > 1).any():
        raise NotAManifold(int((repeats > 1).sum()), "run the same way in both of their triangles")


def boundary_vertices(faces: Int[np.ndarray, "F 3"], count: int) -> Bool[np.ndarray, " V"]:
    """Returns a mask of the vertices that lie on open edges of the mesh."""
    edges, _, uses = edges_of(faces)
    flags = np.zeros(count, bool)
    flags[edges[uses == 1].ravel()] = True
    return flags


def vertex_areas(vertices: Float[np.ndarray, "V 3"], faces: Int[np.ndarray, "F 3"]) -> Float[np.ndarray, " V"]:
    """Returns, for each vertex, a third of the area of the triangles around it (mm²)."""
    area = np.linalg.norm(face_normals(vertices, faces), axis=1) / 6
    return np.bincount(faces.ravel(), np.repeat(area, 3), len(vertices))


def boundary_loops(faces: Int[np.ndarray, "F 3"]) -> list[list[int]]:
    """Returns the open borders of a mesh, each as a list of vertex indices in the direction of the triangles at the
    border. Raises NotAManifold if a border touches itself."""
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
    """Returns triangles that close a long opening such as a mouth or an eye: a strip from the border vertex with the
    smallest x to the one with the largest x. The strip of triangles needs no new vertices. The triangles have the
    orientation of the surface around the opening if ``loop`` is a result of ``boundary_loops``."""
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


def opened_faces(levels: Mapping[str, Int[np.ndarray, "F 3"]]) -> Int[np.ndarray, "G 3"]:
    """Returns the triangles of the finest mesh without those that close eyes and mouth. The closing triangles are the
    last ones of the coarse mesh ``cage``, and each coarse triangle becomes the same number of fine triangles."""
    cage, full = levels["cage"], levels["full"]
    first, closing = len(cage), MAX_CLOSING if len(boundary_loops(cage)) == 1 else 0
    for count in range(len(cage) - 1, len(cage) - closing, -1):
        try:
            borders = len(boundary_loops(cage[:count]))
        except NotAManifold:
            borders = 0
        if borders == OPENINGS:
            first = count
        elif first < len(cage):
            break
    return full[: first * (len(full) // len(cage))]


def subdivision(faces: Int[np.ndarray, "F 3"], count: int) -> tuple[sparse.csr_array, Int[np.ndarray, "F4 3"]]:
    """Computes one step of Loop subdivision: the operator ((V + E) x V) from old vertices to new vertices, and the
    refined triangles. In the new vertex order, the old vertices come first."""
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
    """Computes several steps of Loop subdivision as one operator (the identity for 0 steps), and refined triangles."""
    operator: sparse.csr_array = sparse.csr_array(sparse.identity(count, format="csr"))
    for _ in range(steps):
        step, faces = subdivision(faces, row_count(operator))
        operator = sparse.csr_array(step @ operator)
    return operator, faces.astype(np.int32)
