"""Provides the meshes of control points on which a displacement is solved: as fine as photographs resolve, and no
finer.

A model that refines its cage by subdivision has both: its cage, and the mesh one step before its full level (edges of
1.7 mm in the face, where the windows of dense matching are 2.6 mm wide). The full level follows these smoothly. A model
without subdivision is solved on its own vertices, and before that on a decimated level.
"""

from dataclasses import dataclass
from functools import lru_cache

import numpy as np
import scipy.sparse as sparse
from jaxtyping import Int
from scipy.spatial import KDTree

from pipeline.head_model.model import HeadModel
from pipeline.head_model.subdivision import row_count, subdivision

MAX_COARSE = 5000  # nodes in three dimensions: 0.2 s to solve exactly
NEIGHBOURS = 4


@dataclass(frozen=True, slots=True, eq=False)
class NodeMesh:
    """Holds a mesh of control points, the nodes. A displacement of the nodes gives that of the full level: ``full =
    operator @ nodes``."""

    faces: Int[np.ndarray, "f 3"]
    operator: sparse.csr_array  # (v, n)
    shape: sparse.csr_array  # (n, v): a vertex of the full level for each node, to lay the mesh out by


@dataclass(frozen=True, slots=True, eq=False)
class Nodes:
    """Holds the coarse and the fine mesh of control points that a displacement is solved on."""

    coarse: NodeMesh
    fine: NodeMesh


@lru_cache(maxsize=2)  # models are few, jobs are many
def solving_nodes(model: HeadModel) -> Nodes:
    """Returns the coarse and the fine control mesh of a model."""
    full, cage = model.levels["full"], model.levels["cage"]
    if full.count == cage.count:
        full_nodes = node_mesh(full.faces, sparse.csr_array(sparse.identity(full.count, format="csr")))
        return Nodes(_decimated(model) if full.count > MAX_COARSE else full_nodes, full_nodes)
    faces, to_nodes = cage.faces, sparse.csr_array(sparse.identity(cage.count, format="csr"))
    while 4 * len(faces) < len(full.faces):
        step, faces = subdivision(faces, row_count(to_nodes))
        to_nodes = sparse.csr_array(step @ to_nodes)
    last, _ = subdivision(faces, row_count(to_nodes))
    return Nodes(node_mesh(cage.faces, full.operator), node_mesh(faces, last))


def node_mesh(faces: Int[np.ndarray, "f 3"], operator: sparse.csr_array) -> NodeMesh:
    """Returns the control mesh of a subdivision ``operator``. Node i lies at vertex i, since subdivision keeps old
    vertices first."""
    total, count = row_count(operator), row_count(sparse.csr_array(operator.T))
    shape = sparse.csr_array((np.ones(count), (np.arange(count), np.arange(count))), shape=(count, total))
    return NodeMesh(faces, sparse.csr_array(operator), shape)


def _decimated(model: HeadModel) -> NodeMesh:
    level, mean = model.levels["p95"], model.vertices(np.zeros(0))
    distance, near = KDTree(mean[level.rows]).query(mean, k=NEIGHBOURS)
    weight = np.exp(-2.0 * (distance / distance[:, -1:]) ** 2)
    weight /= weight.sum(axis=1, keepdims=True)
    start = np.arange(0, NEIGHBOURS * len(mean) + 1, NEIGHBOURS)
    operator = sparse.csr_array((weight.ravel(), near.ravel(), start), shape=(len(mean), level.count))
    columns = (np.ones(level.count), (np.arange(level.count), level.rows))
    return NodeMesh(level.faces, operator, sparse.csr_array(columns, shape=(level.count, len(mean))))
