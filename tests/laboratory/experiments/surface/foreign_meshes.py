"""Meshes that somebody might bring, made of a model's own surface, so that every vertex has a true place and motion.

Each is a sparse matrix from the model's vertices (full level) to its own, and polygons: vertices are the model's, or
middles of its edges or triangles, so that truth is exact although edges run elsewhere.
"""

from dataclasses import dataclass

import numpy as np
import scipy.sparse as sparse
from jaxtyping import Float, Int

from pipeline.head_model.decimation import decimate
from rig.formats.meshes.polygon_obj import PolygonMesh
from rig.mesh import edges_of

CM = 10.0


@dataclass(frozen=True, slots=True, eq=False)
class ForeignMesh:
    """Holds a mesh on a model: ``vertices = operator @ model``, and its polygons."""

    operator: sparse.csr_array  # (t, v)
    polygons: list[Int[np.ndarray, " _"]]

    def file(self, head: Float[np.ndarray, "v 3"]) -> PolygonMesh:
        """Returns the mesh on a head as a file might hold it: in centimetres, lying on its side, off the origin."""
        vertices = (self.operator @ head)[:, [2, 0, 1]] / CM + (3.0, -7.0, 11.0)
        sizes = np.array([len(polygon) for polygon in self.polygons], np.int32)
        corners = np.concatenate(self.polygons).astype(np.int32)
        return PolygonMesh(vertices, sizes, corners, np.zeros((0, 2)), np.full(len(corners), -1, np.int32))


def shuffled(faces: Int[np.ndarray, "f 3"], rows: Int[np.ndarray, " t"], count: int, seed: int) -> ForeignMesh:
    """Returns some of a model's ``count`` vertices (``rows``) and the triangles among them, in another order."""
    order = np.random.default_rng(seed).permutation(len(rows))
    operator = sparse.csr_array((np.ones(len(rows)), (np.arange(len(rows)), rows[order])), shape=(len(rows), count))
    return ForeignMesh(operator, [*np.argsort(order)[faces]])


def dual(faces: Int[np.ndarray, "f 3"], count: int) -> ForeignMesh:
    """Returns the dual mesh: a vertex at the middle of every triangle, a polygon about every vertex inside."""
    after: dict[int, dict[int, tuple[int, int]]] = {}
    for number, (a, b, c) in enumerate(faces.tolist()):
        for vertex, first, second in ((a, b, c), (b, c, a), (c, a, b)):
            after.setdefault(vertex, {})[first] = (second, number)
    rings = [ring for around in after.values() if (ring := _ring(around))]
    used, corners = np.unique(np.concatenate(rings), return_inverse=True)
    thirds = (np.full(3 * len(used), 1.0 / 3.0), (np.repeat(np.arange(len(used)), 3), faces[used].ravel()))
    ends = np.cumsum([len(ring) for ring in rings])[:-1]
    return ForeignMesh(sparse.csr_array(thirds, shape=(len(used), count)), np.split(corners, ends))


def _ring(after: dict[int, tuple[int, int]]) -> list[int]:
    """Returns the triangles about a vertex in their order; none on a border."""
    first = here = next(iter(after))
    found = []
    while here in after:
        here, number = after[here]
        found.append(number)
        if here == first:
            return found if len(found) == len(after) else []
    return []


def decimated_split(vertices: Float[np.ndarray, "v 3"], faces: Int[np.ndarray, "f 3"], triangles: int) -> ForeignMesh:
    """Returns the surface split into four at the middles of its edges, then decimated to a number of triangles: edges
    run elsewhere, and most vertices that stay are the surface's own."""
    count = len(vertices)
    edges, opposite, _ = edges_of(faces)
    a, b, c = faces.T
    near_a, near_b, near_c = (count + opposite).T  # the middle of the edge opposite each corner
    quarters = [(a, near_c, near_b), (b, near_a, near_c), (c, near_b, near_a), (near_a, near_b, near_c)]
    fine = np.concatenate([np.stack(quarter, axis=1) for quarter in quarters])
    places = (np.repeat(np.arange(len(edges)), 2), edges.ravel())
    middles = sparse.csr_array((np.full(2 * len(edges), 0.5), places), shape=(len(edges), count))
    whole = sparse.csr_array(sparse.vstack([sparse.eye_array(count), middles]))
    points = whole @ vertices
    # weights of three decades let chance decide where edges run
    weight = 10.0 ** np.random.default_rng(0).uniform(0.0, 3.0, len(points))
    rows, kept = decimate(points, fine, (triangles,), importance=weight, fixed=np.zeros(len(points), bool))[0]
    return ForeignMesh(sparse.csr_array(whole[rows]), [*kept])
