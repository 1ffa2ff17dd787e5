"""Solves for the displacement that best agrees with the field's prior and point-to-plane observations, and computes its
uncertainty.

The unknown is a field w of unit variance on control points (nodes), with ``d`` = 3 or 1 (along the normals) components
for each. The head moves by ``operator @ (amplitude w direction)``. An observation ``dot(n, X) = e`` has the information
q. The cost ``tr(w^T Q w) + sum q (dot(n, dX(w)) - e)^2`` is minimised exactly as a sparse linear problem. A random draw
from the posterior needs one more solution (Papandreou and Yuille 2010, *Gaussian sampling by local perturbations*).

The nodes are no denser than the photographs' resolution. A model with subdivision has two meshes of nodes: its coarsest
mesh (the cage), and the mesh one subdivision step before the full mesh (edges of 1.7 mm in the face; the windows of
dense matching are 2.6 mm wide). A model without subdivision is solved first on a decimated mesh, then on its own
vertices.
"""

from dataclasses import dataclass
from functools import lru_cache

import numpy as np
import scipy.sparse as sparse
from jaxtyping import Bool, Float, Int
from scipy.sparse.linalg import SuperLU
from scipy.spatial import KDTree

from pipeline.compute.trace import traced
from pipeline.detail.smooth_field import SmoothField
from pipeline.estimation.positive_definite import factorised
from pipeline.head_model.model import HeadModel
from pipeline.head_model.subdivision import row_count, subdivision

MAX_COARSE = 5000  # nodes in three dimensions: 0.2 s to solve exactly
NEIGHBOURS = 4


@dataclass(frozen=True, slots=True, eq=False)
class NodeMesh:
    """Holds a mesh of control points, the nodes. The nodes' displacement defines that of the full mesh: ``full =
    operator @ nodes``."""

    faces: Int[np.ndarray, "f 3"]
    operator: sparse.csr_array  # (v, n)
    shape: sparse.csr_array  # (n, v): a vertex of the full level for each node, to lay the mesh out by


@dataclass(frozen=True, slots=True, eq=False)
class Nodes:
    """Holds the coarse and the fine mesh of control points on which a displacement is solved."""

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
    """Returns the control mesh of a subdivision ``operator``. Node i lies at vertex i, since a subdivision numbers the
    old vertices first."""
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


@dataclass(frozen=True, slots=True, eq=False)
class Observed:
    """Holds n observations of the surface: offsets (mm) along normals at points inside triangles of the full mesh, with
    their information (mm^-2)."""

    corner: Int[np.ndarray, "n 3"]
    blend: Float[np.ndarray, "n 3"]
    normal: Float[np.ndarray, "n 3"]  # unit
    offset_mm: Float[np.ndarray, " n"]  # along the normal, from the undisplaced head
    information: Float[np.ndarray, " n"]  # mm^-2, robust weight included

    def chosen(self, rows: Bool[np.ndarray, " n"]) -> "Observed":
        """Returns the observations with the indices ``rows``."""
        return Observed(
            self.corner[rows], self.blend[rows], self.normal[rows], self.offset_mm[rows], self.information[rows]
        )

    def joined(self, other: "Observed") -> "Observed":
        """Concatenates two sets of observations."""
        return Observed(
            np.concatenate([self.corner, other.corner]),
            np.concatenate([self.blend, other.blend]),
            np.concatenate([self.normal, other.normal]),
            np.concatenate([self.offset_mm, other.offset_mm]),
            np.concatenate([self.information, other.information]),
        )


@dataclass(frozen=True, slots=True, eq=False)
class Directions:
    """Holds the matrix (3 v, d n) that converts the solver's unknowns, d at each of n nodes, to the x, y and z
    displacements (mm) of the head's v vertices."""

    matrix: sparse.csr_array
    count: int  # d

    def moved(self, field: Float[np.ndarray, " u"]) -> Float[np.ndarray, "v 3"]:
        """Returns the displacement (mm) of every vertex for given values of the field."""
        return (self.matrix @ field).reshape(-1, 3)


def free_directions(mesh: NodeMesh, amplitude_mm: Float[np.ndarray, " n"]) -> Directions:
    """Returns ``Directions`` for nodes that move along x, y and z, scaled by their amplitudes (mm)."""
    scaled = mesh.operator @ sparse.diags_array(amplitude_mm)
    return Directions(sparse.csr_array(sparse.kron(scaled, sparse.identity(3), format="csr")), 3)


def normal_directions(
    mesh: NodeMesh, amplitude_mm: Float[np.ndarray, " n"], normals: Float[np.ndarray, "v 3"]
) -> Directions:
    """Returns ``Directions`` for vertices that move only along their normals, by amounts interpolated from the
    nodes."""
    scaled = sparse.csr_array(mesh.operator @ sparse.diags_array(amplitude_mm))
    vertices = len(normals)
    along = sparse.csr_array(
        (normals.ravel(), np.repeat(np.arange(vertices), 3), np.arange(3 * vertices + 1)),
        shape=(3 * vertices, vertices),
    )
    return Directions(sparse.csr_array(along @ scaled), 1)


@dataclass(frozen=True, slots=True, eq=False)
class Posterior:
    """Holds the Gaussian posterior of the field at the nodes: its mean and the factorised precision matrix."""

    mean: Float[np.ndarray, " u"]
    factor: SuperLU
    rows: sparse.csr_array  # of the observations, by the root of their information
    field: SmoothField
    directions: Directions

    def draws(self, rng: np.random.Generator, count: int) -> Float[np.ndarray, "u c"]:
        """Returns ``count`` random deviations of the field from the posterior mean, one in each column."""
        d = self.directions.count
        prior = self.field.draw(rng, count * d).reshape(-1, d, count).reshape(-1, count)
        noise = rng.standard_normal((row_count(self.rows), count))
        return self.factor.solve(prior + self.rows.T @ noise)


@traced
def solve_field(field: SmoothField, directions: Directions, observed: Observed) -> Posterior:
    """Computes the posterior of the displacement field from its prior and the observations.

    Args:
        field: the unit field's prior on the nodes.
        directions: how the head follows the nodes.
        observed: the observations, of the head without displacement.
    """
    rows = sparse.csr_array(_planes(observed, row_count(directions.matrix)) @ directions.matrix)
    prior = sparse.kron(field.precision(), sparse.identity(directions.count), format="csr")
    right = rows.T @ (np.sqrt(observed.information) * observed.offset_mm)
    factor = factorised(sparse.csc_array(prior + rows.T @ rows))
    return Posterior(factor.solve(right), factor, rows, field, directions)


def _planes(observed: Observed, coordinates: int) -> sparse.csr_array:
    """Returns the matrix that maps the coordinates of all vertices to ``sqrt(information) dot(normal, X)`` for each
    observation, with the point X on the head."""
    count = len(observed.corner)
    value = np.sqrt(observed.information)[:, None, None] * observed.blend[:, :, None] * observed.normal[:, None, :]
    column = 3 * observed.corner[:, :, None].astype(np.int64) + np.arange(3)
    return sparse.csr_array((value.ravel(), column.ravel(), np.arange(0, 9 * count + 1, 9)), shape=(count, coordinates))
