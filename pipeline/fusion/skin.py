"""Combines the fused surface with the fitted head, which serves as the prior where the surface is skin.

Each vertex of the surface has a height over the closest point of the head. The estimated heights u minimise

    sum_i w_i (d_i - u_i)^2 / (n_i s_i^2)  +  sum_i p_i k_i (u_i / l)^2  +  sum_(i, j) sqrt(k_i k_j) (u_i - u_j)^2.

In this sum d are the measured heights and s their standard deviation, which n neighbours have in common. p is the
probability of skin, and the stiffness k is the inverse variance of the head's error. With these equations noisy regions
take the head's shape, and regions without depth continue the heights at their border smoothly. A head with a large
error hardly changes the measured surface. Hair (p = 0) is not changed, and p gives a smooth transition to skin.

The robust weight w falls where a measured height differs from the estimate by several combined standard deviations
(Geman and McClure's weights, from wide to narrow). The weight rejects single craters and specks, but keeps whole
regions of different height, such as an open mouth. Where depth and head differ over a whole region, the head's standard
deviation is enlarged, since the model cannot represent the subject there.
"""

from dataclasses import dataclass

import numpy as np
from jaxtyping import Bool, Float, Int32, Int64

from pipeline.compute.trace import traced
from pipeline.fusion.prior import near_rim
from pipeline.fusion.refinement import SeenVertices, neighbours
from pipeline.fusion.vote_kernels import blurred_over_mesh, smooth_offsets
from pipeline.geometry.surface_index import SurfaceIndex
from rig.mesh import Mesh, face_normals

PerVertex = Float[np.ndarray, " v"]

Adjacency = tuple[Int64[np.ndarray, " s"], Int32[np.ndarray, " e"]]

REACH_MM = 15.0  # height over the head above which the surface is something else (hair, a collar, a hand)
SURROUNDINGS = 24  # steps of a mean over neighbours: 5 mm (standard deviation) where vertices are 1.5 mm apart
STEP_SHARE = 0.46  # variance of one step of a mean, by the area of a vertex
DOUBTED_MM = 10.0  # standard deviation of the mean by which depth doubts the head: chance matches make pits 8 mm wide
# Radius within which depths err alike (highlights, shading, repeated patterns), and guesses of what no view sees.
CORRELATED_MM, GUESSES_CORRELATED_MM = 16.0, 5.0
MIN_DEVIATION_MM = 0.12  # of depth and of the head: what neither states (cameras, shading)
STIFFNESS = 0.4  # of the head's error by its inverse variance
LENGTH_MM = 7.5  # over which the head's error falls to zero on skin
# Deviation that a head states, on skin and under hair, from which on its error is not smooth (ears lie beside their
# place), and how far depth may differ from it over a neighbourhood.
SURE_MM, SURE_UNDER_HAIR_MM, DOUBT_MM = 2.0, 1.0, 1.0
SKIN_ABOVE, BELOW_MM = 0.5, 1.0  # p from which on a place so far below the head is skin: no hair grows there
OUTLIER_DEVIATIONS = 3.0  # of depth and head together: the scale of Geman and McClure's weights ...
NARROWING = (8.0, 4.0, 2.0, 1.0)  # ... and by what it is multiplied, round after round
SWEEPS, OVER_RELAXATION = 16, 1.6  # in each round
CANDIDATES = 3  # triangles compared for each vertex: twice as fast as six, off by more than 0.01 mm in one of 100


@dataclass(frozen=True, slots=True, eq=False)
class HeadSkin:
    """Holds the final head and its standard deviation as the prior of skin."""

    mesh_world: Mesh  # mm
    deviation_mm: PerVertex  # standard deviation of each vertex along its normal


@dataclass(frozen=True, slots=True, eq=False)
class HeightField:
    """Holds the heights of n vertices of a surface over the head."""

    row: Int64[np.ndarray, " n"]  # vertices that have a height
    height_mm: Float[np.ndarray, " n"]
    normal: Float[np.ndarray, "n 3"]  # of the head, along which heights are measured
    deviation_mm: Float[np.ndarray, " n"]  # that the head states


@traced
def combine_with_head(
    mesh_world: Mesh,
    skin: PerVertex,
    head: HeadSkin,
    deviation_mm: PerVertex,
    seen: SeenVertices,
    hairy: Bool[np.ndarray, " v"],
) -> Mesh:
    """Moves the vertices of skin along the head's normals to the estimated heights.

    Args:
        mesh_world: the fused surface, closed, mm.
        skin: probability that a vertex shows skin; 0 where no view sees it.
        head: the final head.
        deviation_mm: standard deviation of depth along the normal, for vertices that a view sees.
        seen: mask of the vertices that any view sees.
        hairy: mask of the vertices with hair's colour, among them skin under stubble or a beard.
    """
    field = heights_over(head, mesh_world)
    if not len(field.row) or not seen.themselves.any():
        return mesh_world
    count, row = len(deviation_mm), field.row
    beside = neighbours(mesh_world.faces, count)
    share = skin_share(beside, skin, seen)
    noise_mm = depth_deviation_mm(beside, deviation_mm, seen)
    height, stated_mm, within = np.zeros(count), np.zeros(count), np.zeros(count)
    height[row], stated_mm[row], within[row] = field.height_mm, np.hypot(field.deviation_mm, MIN_DEVIATION_MM), 1.0
    share = np.where(share > SKIN_ABOVE, np.maximum(share, np.clip(-height / BELOW_MM, 0.0, 1.0)), share)
    area_mm2 = 0.5 * np.linalg.norm(face_normals(mesh_world.vertices, mesh_world.faces), axis=1).sum() / count
    most = 4.0 * np.hypot(noise_mm, stated_mm)
    shown = within * seen.themselves * skin
    offset = within * mean_around(
        beside, np.clip(height, -most, most), shown, round(DOUBTED_MM**2 / (STEP_SHARE * area_mm2))
    )
    doubt_mm = np.sqrt(mean_around(beside, offset**2, shown))
    head_mm = np.hypot(stated_mm, doubt_mm)
    unsure = np.maximum(stated_mm / np.where(hairy, SURE_UNDER_HAIR_MM, SURE_MM), doubt_mm / DOUBT_MM)
    stiffness = within * head_stiffness(head_mm, unsure)
    pull = share * stiffness * area_mm2 / LENGTH_MM**2
    information = within * depth_information(noise_mm, seen.themselves, area_mm2)
    both_mm, root = np.hypot(noise_mm, head_mm), np.sqrt(stiffness)
    estimate = offset
    for narrowing in NARROWING:
        off = (height - estimate) / (OUTLIER_DEVIATIONS * narrowing * both_mm)
        data = information / (1.0 + off**2) ** 2
        total = data + pull
        target = data * height / np.maximum(total, 1e-12)
        estimate = smooth_offsets(estimate, target, total, *beside, root, SWEEPS, OVER_RELAXATION)
    vertices = mesh_world.vertices.copy()
    vertices[row] += (share * (estimate - height))[row, None] * field.normal
    return Mesh(vertices, mesh_world.faces)


def depth_deviation_mm(beside: Adjacency, stated_mm: PerVertex, seen: SeenVertices) -> PerVertex:
    """Returns the standard deviation s of the measured heights, at least ``MIN_DEVIATION_MM``: the larger of a vertex's
    value and the mean around it. For unseen vertices s grows with the distance to seen vertices."""
    around_mm = mean_around(beside, stated_mm, seen.themselves.astype(float))
    noise_mm = np.where(seen.themselves, np.maximum(stated_mm, around_mm), seen.guess_deviation_mm())
    return np.hypot(noise_mm, MIN_DEVIATION_MM)


def head_stiffness(head_mm: PerVertex, unsure: PerVertex) -> PerVertex:
    """Returns the stiffness k (1/mm2) of the head, 0 to ``STIFFNESS / MIN_DEVIATION_MM**2``. Where ``unsure`` exceeds
    1, the stiffness falls with the square of ``unsure``."""
    return STIFFNESS / (np.maximum(head_mm, MIN_DEVIATION_MM) * np.maximum(unsure, 1.0)) ** 2


def depth_information(noise_mm: PerVertex, seen: Bool[np.ndarray, " v"], area_mm2: float) -> PerVertex:
    """Returns the information 1 / (n s^2) (1/mm2), 0 to ``1 / MIN_DEVIATION_MM**2``. n, at least 1, is the number of
    vertices of ``area_mm2`` each that have a common depth error."""
    alike = np.pi * np.where(seen, CORRELATED_MM, GUESSES_CORRELATED_MM) ** 2 / area_mm2
    return 1.0 / (noise_mm**2 * np.maximum(alike, 1.0))


def heights_over(head: HeadSkin, mesh_world: Mesh) -> HeightField:
    """Returns the heights of the surface's vertices over the head. Vertices farther than ``REACH_MM``, with another
    normal, or near the neck's open border are left out."""
    vertices, normals, skin = mesh_world.vertices, mesh_world.normals(), head.mesh_world
    low, high = skin.vertices.min(axis=0) - REACH_MM, skin.vertices.max(axis=0) + REACH_MM
    row = np.flatnonzero(((vertices > low) & (vertices < high)).all(axis=1))
    hit = SurfaceIndex(skin.vertices, skin.faces).closest(vertices[row], CANDIDATES, facing=normals[row])
    corner = skin.faces[hit.triangles]
    normal = np.einsum("nk,nkx->nx", hit.weights, skin.normals()[corner])
    normal /= np.maximum(np.linalg.norm(normal, axis=1, keepdims=True), 1e-9)
    near = (hit.distances < REACH_MM) & ((hit.normals * normals[row]).sum(axis=1) > 0.0)
    near &= ~near_rim(skin, hit.points)
    height = ((vertices[row] - hit.points) * normal).sum(axis=1)
    deviation_mm = (head.deviation_mm[corner] * hit.weights).sum(axis=1)
    return HeightField(row[near], height[near], normal[near], deviation_mm[near])


def skin_share(beside: Adjacency, skin: PerVertex, seen: SeenVertices) -> PerVertex:
    """Returns the probability that each vertex shows skin; an unseen vertex gets that of the nearest seen vertex."""
    around = mean_around(beside, skin, seen.themselves.astype(float))
    share = np.where(seen.themselves, skin, around[seen.nearest])
    return np.where(seen.themselves, skin, mean_around(beside, share, np.ones(len(skin))))


def mean_around(beside: Adjacency, values: PerVertex, weight: PerVertex, steps: int = SURROUNDINGS) -> PerVertex:
    """Returns, for each vertex of a closed mesh, the weighted mean of the values around it (``steps`` edges); about 0
    where all weights are 0. ``beside`` are the mesh's ``neighbours``."""
    both = blurred_over_mesh(np.stack([weight * values, weight], axis=1).astype(float), *beside, steps)
    return both[:, 0] / np.maximum(both[:, 1], 1e-6)
