"""Moves vertices of the head outwards to the bust's surface where the bust is hair.

Every vertex moves along the head's smoothed normal at this vertex, until it meets the bust's hair. No vertex ends
inside the skin. The mesh retains the head's vertex order, so templates can be bound to it. Hair that hangs beside the
head is not covered, since the head has no vertices for it.
"""

from dataclasses import dataclass

import numpy as np
import scipy.sparse as sparse
from jaxtyping import Bool, Float, Int, UInt8
from scipy.sparse.linalg import cg
from scipy.spatial import KDTree

from pipeline.fusion.untangling import Topology, topology_of, untangle
from pipeline.geometry.surface_index import SurfaceIndex
from pipeline.part_labels.codes import Part
from rig.mesh import Mesh, vertex_normals

CANDIDATES = 12
DIRECTION_STEPS = 150  # of averaging normals over neighbours: about 15 mm, so that ears and folds do not spread them
REACH_MM = 70.0  # hair that stands farther off does not follow the head's topology
TRACE_STEPS, TRACED_MM = 40, 0.2  # of the search along a direction, and how near to the bust it ends
INSIDE_MM = 0.3  # a vertex deeper than that below the bust is covered
WEIGHTS = {Part.SKIN: 1.0, Part.HAIR: 1.0, Part.CLOTHES: 0.2, Part.UNSEEN: 0.02}  # of what the bust shows there
STIFFNESS = 2.0  # of the field's bending, beside 1 of a vertex that meets hair
PULLS = (3.0, 2.0, 2.0)  # stiffness of the steps that then draw the shell to the nearest hair
MIN_WEIGHT = 1e-3  # of a vertex that nothing is known of: it stays, rather than swing out
PULL_MM = 6.0  # hair nearer than that draws a vertex
NEAR_MM = 2.0  # hair no farther from the shell is covered
MIN_COVERED = 0.9  # of the visible hair: less is told


@dataclass(frozen=True, slots=True, eq=False)
class HairShell:
    """Holds the head with its vertices moved outwards to the hair."""

    vertices_world: Float[np.ndarray, "v 3"]  # of the head's full level, mm
    height_mm: Float[np.ndarray, " v"]  # of each above the skin
    covered: float  # share of the bust's hair within ``NEAR_MM`` of the shell; 1 without hair


def move_to_hair(head: Mesh, bust: Mesh, part: UInt8[np.ndarray, " b"]) -> HairShell:
    """Moves a head outwards to the hair of a bust whose vertices have the labels ``part`` (codes of ``Part``)."""
    if not (part == Part.HAIR).any():
        return HairShell(head.vertices, np.zeros(len(head.vertices)), 1.0)
    topology = topology_of(head.faces, len(head.vertices))
    directions = smooth_directions(head, topology)
    surface = SurfaceIndex(bust.vertices, bust.faces)
    heights, hit = _traced(head, directions, surface)
    shown = part[bust.faces[hit]].max(axis=1)
    weights = np.vectorize(WEIGHTS.__getitem__, otypes=[float])(shown)
    # What is unseen counts as the nearest seen part: the back of a head gets the hair of its sides, a nape no collar.
    seen = np.flatnonzero(shown != Part.UNSEEN)
    nearest_part = shown[seen[KDTree(head.vertices[seen]).query(head.vertices)[1]]]
    heights = np.where(nearest_part == Part.HAIR, heights, 0.0)
    weights[heights >= REACH_MM] = 0.0
    bending = _bending(topology)
    field = np.maximum(_solved(bending, STIFFNESS, weights, heights[:, None])[:, 0], 0.0)
    out = head.vertices + field[:, None] * directions
    out = _pulled(out, head, surface, part[bust.faces].max(axis=1) == Part.HAIR, bending, field > INSIDE_MM)
    out = _outside(untangle(_outside(out, head), topology), head)
    height = np.linalg.norm(out - head.vertices, axis=1)
    return HairShell(out, height, covered_share(Mesh(out, head.faces), bust, part))


def covered_share(shell: Mesh, bust: Mesh, part: UInt8[np.ndarray, " b"]) -> float:
    """Returns the fraction of the bust's hair vertices that lie within ``NEAR_MM`` of a mesh."""
    hair = bust.vertices[part == Part.HAIR]
    if not len(hair):
        return 1.0
    return float((SurfaceIndex(shell.vertices, shell.faces).closest(hair, CANDIDATES).distances < NEAR_MM).mean())


def smooth_directions(head: Mesh, topology: Topology) -> Float[np.ndarray, "v 3"]:
    """Returns unit vectors out of the head: its vertex normals, smoothed over the mesh."""
    directions, beside = head.normals(), topology.beside
    degree = np.maximum(np.asarray(beside.sum(axis=1)).ravel(), 1.0)[:, None]
    for _ in range(DIRECTION_STEPS):
        directions = 0.5 * directions + 0.5 * (beside @ directions) / degree
    return directions / np.maximum(np.linalg.norm(directions, axis=1, keepdims=True), 1e-12)


def _traced(
    head: Mesh, directions: Float[np.ndarray, "v 3"], surface: SurfaceIndex
) -> tuple[Float[np.ndarray, " v"], Int[np.ndarray, " v"]]:
    """Traces a ray from each vertex along its direction to the bust. Returns the distance (mm; ``REACH_MM`` without a
    hit) and the bust's triangle. Each step is as long as the distance to the nearest surface."""
    hits = surface.closest(head.vertices, CANDIDATES, facing=directions)
    depth = np.einsum("nx,nx->n", hits.points - head.vertices, hits.normals)
    heights, hit = np.zeros(len(head.vertices)), hits.triangles.copy()
    active = np.flatnonzero(depth > INSIDE_MM)
    for _ in range(TRACE_STEPS):
        at = head.vertices[active] + heights[active, None] * directions[active]
        near = surface.closest(at, CANDIDATES, facing=directions[active])
        heights[active] = np.minimum(heights[active] + near.distances, REACH_MM)
        hit[active] = near.triangles
        active = active[(near.distances > TRACED_MM) & (heights[active] < REACH_MM)]
        if not len(active):
            break
    return heights, hit


def _pulled(
    vertices: Float[np.ndarray, "v 3"],
    head: Mesh,
    surface: SurfaceIndex,
    is_hair: Bool[np.ndarray, " t"],
    bending: sparse.csr_array,
    raised: Bool[np.ndarray, " v"],
) -> Float[np.ndarray, "v 3"]:
    """Moves the vertices ``raised`` smoothly to the nearest hair; all other vertices stay."""
    start, out = vertices, vertices
    for stiffness in PULLS:
        hits = surface.closest(out, CANDIDATES, facing=vertex_normals(out, head.faces))
        met = raised & is_hair[hits.triangles] & (hits.distances < PULL_MM)
        weights = np.where(met, 1.0, np.where(raised, 0.02, 1.0))
        wanted = np.where(met[:, None], hits.points - start, 0.0)
        out = start + _solved(bending, stiffness, weights, wanted)
    return out


def _outside(vertices: Float[np.ndarray, "v 3"], head: Mesh) -> Float[np.ndarray, "v 3"]:
    """Moves vertices that lie inside the head, or behind their own skin, back onto the skin."""
    hits = SurfaceIndex(head.vertices, head.faces).closest(vertices, CANDIDATES)
    inside = np.einsum("nx,nx->n", vertices - hits.points, hits.normals) < 0.0
    return np.where(inside[:, None], head.vertices, vertices)


def _bending(topology: Topology) -> sparse.csr_array:
    degree = np.maximum(np.asarray(topology.beside.sum(axis=1)).ravel(), 1.0)
    laplacian = sparse.eye_array(len(degree)) - sparse.diags_array(1.0 / degree) @ topology.beside
    return sparse.csr_array(laplacian.T @ laplacian)


def _solved(
    bending: sparse.csr_array, stiffness: float, weights: Float[np.ndarray, " v"], wanted: Float[np.ndarray, "v k"]
) -> Float[np.ndarray, "v k"]:
    """Returns the smooth field that is nearest to the wanted values in weighted least squares. The solver uses
    conjugate gradients, since a factorisation for 53,000 vertices takes six seconds."""
    system = sparse.csr_array(sparse.diags_array(weights + MIN_WEIGHT) + stiffness * bending)
    inverse = sparse.diags_array(1.0 / np.asarray(system.diagonal(), dtype=np.float64))
    right = weights[:, None] * wanted
    return np.stack([cg(system, column, rtol=1e-5, maxiter=500, M=inverse)[0] for column in right.T], axis=1)
