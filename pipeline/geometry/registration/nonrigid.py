"""Deforms a mesh smoothly onto another surface by non-rigid closest points (Amberg, Romdhani and Vetter 2007); each
step is linear in the displacements. The module also warps points by landmarks (the paper's section 3.2, step 3:
scattered-data interpolation).

The warp uses the distance itself as its radial kernel, which minimises bending in three dimensions (F. Bookstein's thin
plate in 3-D; Carr et al. 2001, *Reconstruction and Representation of 3D Objects with Radial Basis Functions*, section
3). An additional linear polynomial makes affine motions exact everywhere."""

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from types import MappingProxyType

import numpy as np
import scipy.sparse as sparse
from jaxtyping import Float, Int
from scipy.sparse.linalg import splu
from scipy.spatial import KDTree
from scipy.spatial.distance import cdist

from rig.mesh import edges_of, vertex_normals


@dataclass(frozen=True, slots=True)
class Search:
    """Holds the limits for one stage of a search for correspondences between vertices and a scan. Lengths are in mm."""

    steps: int
    reach_mm: float  # a match farther than this is another part of the head
    normal_mm: float  # a right angle between normals counts as much as this many mm
    plane_mm: float  # residual that weighs as much as one standard deviation of a mode, per cm2


@dataclass(frozen=True, slots=True, eq=False)
class Target:
    """Holds points on a surface with their normals; ``marks`` are its landmarks."""

    vertices: Float[np.ndarray, "S 3"]
    normals: Float[np.ndarray, "S 3"]
    marks: Float[np.ndarray, "L 3"]


def oriented_tree(target: Target, search: Search) -> KDTree:
    """Returns a search tree over positions and normals of the scan's points."""
    return KDTree(np.concatenate([target.vertices, target.normals * search.normal_mm], 1), balanced_tree=False)


def draw_to_target(
    start: Float[np.ndarray, "V 3"],
    faces: Int[np.ndarray, "F 3"],
    target: Target,
    search: Search,
    stiffnesses: Sequence[float],
    *,
    marks: Mapping[int, Float[np.ndarray, " 3"]] = MappingProxyType({}),
    mark_weight: float = 0.0,
) -> Float[np.ndarray, "V 3"]:
    """Deforms a mesh onto a target by non-rigid closest points (``draw_to_matches``). Each vertex is matched with the
    point that is nearest by position and normal together. ``marks`` are target positions (mm) by vertex index."""
    tree, fixed = oriented_tree(target, search), np.array(list(marks), int)

    def match(shape: Float[np.ndarray, "V 3"]) -> tuple[Float[np.ndarray, "V 3"], Float[np.ndarray, " V"]]:
        near, weight = match_points(shape, faces, target, tree, search)
        normals = target.normals[near]
        wanted = shape + dots(target.vertices[near] - shape, normals)[:, None] * normals
        if marks:
            wanted[fixed], weight[fixed] = np.array(list(marks.values())), mark_weight
        return wanted, weight

    return draw_to_matches(start, faces, match, stiffnesses)


def draw_to_matches(
    start: Float[np.ndarray, "V 3"],
    faces: Int[np.ndarray, "F 3"],
    match: Callable[[Float[np.ndarray, "V 3"]], tuple[Float[np.ndarray, "V 3"], Float[np.ndarray, " V"]]],
    stiffnesses: Sequence[float],
) -> Float[np.ndarray, "V 3"]:
    """Moves a mesh's vertices smoothly to matched positions by non-rigid closest points, with one step for each
    stiffness.

    Each step solves (W + k L^T L) u = W d for the displacements u from ``start``, with stiffness k, weights W and
    distances d to the matches. L is the graph Laplacian, so nearly affine motions cost little; all three axes have the
    same matrix. ``match`` returns the target position (mm) and the weight of every vertex. The target position should
    lie along the normal at the match, so that the vertex does not slide in the tangent plane."""
    bending, shape = _bending(faces, start), start
    for stiffness in stiffnesses:
        wanted, weight = match(shape)
        system = sparse.csc_array(sparse.diags_array(weight + 1e-4) + stiffness * bending)
        solver = splu(system, permc_spec="MMD_AT_PLUS_A", options={"SymmetricMode": True})
        shape = start + solver.solve(weight[:, None] * (wanted - start))
    return shape


def match_points(
    shape: Float[np.ndarray, "V 3"], faces: Int[np.ndarray, "F 3"], target: Target, tree: KDTree, search: Search
) -> tuple[Int[np.ndarray, " V"], Float[np.ndarray, " V"]]:
    """Returns the nearest scan point of each vertex, and a weight: 1 for a near point with a similar normal, else 0."""
    normals = vertex_normals(shape, faces)
    near = np.asarray(tree.query(np.concatenate([shape, normals * search.normal_mm], 1), workers=1)[1])
    distance = np.linalg.norm(target.vertices[near] - shape, axis=1)
    facing = dots(normals, target.normals[near])
    return near, np.where((distance < search.reach_mm) & (facing > 0.7), 1.0, 0.0)


def dots(a: Float[np.ndarray, "N 3"], b: Float[np.ndarray, "N 3"]) -> Float[np.ndarray, " N"]:
    """Returns the dot products of n pairs of vectors."""
    return np.einsum("nx,nx->n", a, b)


def _bending(faces: Int[np.ndarray, "F 3"], vertices: Float[np.ndarray, "V 3"]) -> sparse.csr_array:
    """Returns L^T L of a graph Laplacian L whose weights fall with edge length, because vertex density varies."""
    edges, _, _ = edges_of(faces)
    length = np.linalg.norm(vertices[edges[:, 0]] - vertices[edges[:, 1]], axis=1)
    weight = 1 / np.maximum(length, 0.5)
    count = len(vertices)
    both = np.concatenate([edges, edges[:, ::-1]])
    graph = sparse.csr_array((np.tile(weight, 2), (both[:, 0], both[:, 1])), shape=(count, count))
    degree = np.asarray(graph.sum(1)).ravel()
    laplacian = sparse.identity(count) - sparse.diags_array(1 / np.maximum(degree, 1e-12)) @ graph
    return sparse.csr_array(laplacian.T @ laplacian)


def warp_by_landmarks(
    source: Float[np.ndarray, "L 3"],
    target: Float[np.ndarray, "L 3"],
    points: Float[np.ndarray, "N 3"],
    *,
    smoothing: float = 0.0,
) -> Float[np.ndarray, "N 3"]:
    """Moves points by the smooth map that takes each source landmark to its target position. If ``smoothing`` (mm) is
    above 0, landmarks may miss their targets in exchange for less bending. Raises numpy.linalg.LinAlgError unless at
    least 4 landmarks span all three dimensions."""
    count = len(source)
    affine = np.concatenate([np.ones((count, 1)), source], 1)
    system = np.zeros((count + 4, count + 4))
    system[:count, :count] = cdist(source, source) - smoothing * np.eye(count)  # this kernel is negative definite
    system[:count, count:], system[count:, :count] = affine, affine.T
    coefficients = np.linalg.solve(system, np.concatenate([target, np.zeros((4, 3))]))
    return cdist(points, source) @ coefficients[:count] + coefficients[count] + points @ coefficients[count + 1 :]
