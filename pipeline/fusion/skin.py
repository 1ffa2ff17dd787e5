"""Combines the fused surface with the fitted head where both show the same skin. The head is a second measurement of
it, from its own shape and from patches that have no window bias.

Where the two lie as far apart as their errors, the vertex moves to their weighted mean, in which noisy places of the
surface count less. Where they lie farther apart, the surroundings decide. If most of them agree with the head, the
vertex is in a crater or on a speck (a chance match, the rest of a highlight), and moves to the head. If not, one of the
two shows something else (hair, a fold that the head lacks, a wrong head), and the vertex stays. Where silhouettes hold
the head, the two count as agreed, however far apart they lie: on an oily tip of the nose all windows err alike, and
outlines show it in profile. What no view sees is skin, too, where seen skin encloses it: gaps of a few vertices would
stand as pits.

What the two differ by over whole neighbourhoods is no noise of the surface: the head has the wrong shape there. Where
that is much of the skin, by what the head states about itself, the model cannot make this subject (a statue, say), its
details are wrong as well, and the surface stays as it is.
"""

from dataclasses import dataclass

import numpy as np
from jaxtyping import Bool, Float, Int32, Int64

from pipeline.compute.trace import traced
from pipeline.fusion.refinement import neighbours
from pipeline.fusion.refinement_kernels import blurred_over_mesh
from pipeline.geometry.normals import normals_of
from pipeline.geometry.surface_index import SurfaceIndex
from rig.mesh import Mesh

# The head's share of the mean, where skin has texture: against the truth of two captures and two studio heads, better
# than 0.5 and 1. The surface's share falls by its variance (inverse-variance weights) from this deviation on, in mm.
HEAD_SHARE, TEXTURED_MM = 0.7, 0.12
SAME_MM = 1.0  # distance at which agreement has fallen to 1 / e, at least ...
# ... and so many of the deviations that the surface states about a place: 0.15 mm where skin has texture, where 1 mm
# prevails, 0.39 at 512 x 384 with noise of 6 levels. Normals' p95 there: 32 degrees without it, 25 at 4, 23 at 6.
SAME_DEVIATIONS = 6.0
SURROUNDINGS = 24  # steps of a mean over neighbours: 5 mm (standard deviation) where vertices are 1.5 mm apart
CONSENT = (0.5, 0.75)  # mean agreement of the surroundings from which on the head counts, and counts whole
ENCLOSED = (0.5, 0.75)  # mean probability of seen skin around what no view sees, from which on that is skin, and surely
# The upper quartile of the distances of the two over neighbourhoods, by the head's median deviation, up to which the
# head counts whole and from which on it counts for nothing: 0.25 to 0.33 of scan-a, draw-b and scan-a's oily version,
# 0.40 under a beard, 0.54 of a studio head of oily skin, 0.84 of the photographs of a Buddha, whose head
# the model cannot make.
WRONG_SHAPE = (0.6, 0.8)
QUARTILE, SURELY = 0.75, 0.5  # probability from which on a vertex counts as skin there
FARTHEST = 4.0  # times as far nothing of that share is left
CANDIDATES = 3  # triangles looked at for each vertex: twice as fast as six, off by more than 0.01 mm in one of 100


@dataclass(frozen=True, slots=True, eq=False)
class HeadSkin:
    """Holds the part of the fitted head's skin that photographs measured."""

    mesh_world: Mesh  # mm
    deviation_mm: Float[np.ndarray, " v"]  # standard deviation of each vertex
    outlined: Float[np.ndarray, " v"]  # how far silhouettes hold each vertex, 0 to 1


def measured_skin(
    head_world: Mesh,
    deviation_mm: Float[np.ndarray, " v"],
    measured: Bool[np.ndarray, " v"],
    outlined: Float[np.ndarray, " v"] | None = None,
) -> HeadSkin:
    """Returns the head's triangles whose corners are all ``measured``. If ``outlined`` is None, no outline speaks for
    the head."""
    faces = head_world.faces[measured[head_world.faces].all(axis=1)]
    held = np.zeros(len(deviation_mm)) if outlined is None else outlined
    return HeadSkin(Mesh(head_world.vertices, faces), deviation_mm, held)


@traced
def drawn_to_skin(
    mesh_world: Mesh, skin: Float[np.ndarray, " v"], head: HeadSkin, deviation_mm: Float[np.ndarray, " v"]
) -> Mesh:
    """Moves the vertices of skin towards the closest point of the fitted head, to the weighted mean or all the way.

    Args:
        mesh_world: the fused surface, mm.
        skin: probability that a vertex shows skin; 0 where no view sees it.
        head: its skin, as far as photographs measured it.
        deviation_mm: standard deviation along the normal; 0 where no view sees the vertex.
    """
    vertices = mesh_world.vertices.copy()
    beside = neighbours(mesh_world.faces, len(vertices))
    noise_mm = mean_around(beside, deviation_mm, skin)
    same_mm = np.maximum(SAME_MM, SAME_DEVIATIONS * noise_mm)
    reach = FARTHEST * float(same_mm.max(initial=SAME_MM))
    low, high = head.mesh_world.vertices.min(axis=0) - reach, head.mesh_world.vertices.max(axis=0) + reach
    enclosed = _ramp(mean_around(beside, skin, np.ones(len(vertices))), ENCLOSED)
    drawn = np.where(deviation_mm > 0.0, skin, enclosed)
    candidates = np.flatnonzero((drawn > 0.0) & ((vertices > low) & (vertices < high)).all(axis=1))
    if not len(candidates) or not len(head.mesh_world.faces):
        return mesh_world
    normals = normals_of(mesh_world)[candidates]
    hit = SurfaceIndex(head.mesh_world.vertices, head.mesh_world.faces).closest(vertices[candidates], CANDIDATES)
    same = (hit.distances <= FARTHEST * same_mm[candidates]) & ((hit.normals * normals).sum(axis=1) >= 0.0)
    agreement, shown = np.zeros(len(vertices)), np.zeros(len(vertices))
    agreement[candidates] = same * np.exp(-((hit.distances / same_mm[candidates]) ** 2))
    shown[candidates] = skin[candidates]
    held = same * (head.outlined[head.mesh_world.faces[hit.triangles]] * hit.weights).sum(axis=1)
    near, agreement[candidates] = agreement[candidates], np.maximum(agreement[candidates], held)
    around = mean_around(beside, agreement, shown)[candidates]
    consent = np.maximum(_ramp(around, CONSENT), held)
    head_share = 1.0 - (1.0 - HEAD_SHARE) * (TEXTURED_MM / np.maximum(noise_mm[candidates], TEXTURED_MM)) ** 2
    share = drawn[candidates] * same * np.maximum(head_share * near, consent * (1.0 - (1.0 - head_share) * near))
    apart_mm, compared = np.zeros(len(vertices)), np.zeros(len(vertices))
    apart_mm[candidates] = ((hit.points - vertices[candidates]) * hit.normals).sum(axis=1)
    compared[candidates] = skin[candidates] * same
    stated_mm = (head.deviation_mm[head.mesh_world.faces[hit.triangles]] * hit.weights).sum(axis=1)
    offset_mm = mean_around(beside, np.clip(apart_mm, -same_mm, same_mm), compared)[candidates]
    share *= trust_of(offset_mm, stated_mm, compared[candidates])
    vertices[candidates] += share[:, None] * (hit.points - vertices[candidates])
    return Mesh(vertices, mesh_world.faces)


def _ramp(values: Float[np.ndarray, " n"], ends: tuple[float, float]) -> Float[np.ndarray, " n"]:
    """Returns 0 up to the first end, 1 from the second on, and a straight line between them."""
    return np.clip((values - ends[0]) / (ends[1] - ends[0]), 0.0, 1.0)


def trust_of(
    offset_mm: Float[np.ndarray, " n"], stated_mm: Float[np.ndarray, " n"], skin: Float[np.ndarray, " n"]
) -> float:
    """Returns how far the head may be believed, 0 to 1, from its distance to the surface over each place's
    surroundings, its own standard deviation there, and the probability that both show the same skin."""
    sure = skin > SURELY
    if not sure.any():
        return 1.0
    wrong = float(np.quantile(np.abs(offset_mm[sure]), QUARTILE)) / max(float(np.median(stated_mm[sure])), 1e-6)
    return float(np.clip((WRONG_SHAPE[1] - wrong) / (WRONG_SHAPE[1] - WRONG_SHAPE[0]), 0.0, 1.0))


def mean_around(
    beside: tuple[Int64[np.ndarray, " s"], Int32[np.ndarray, " e"]],
    values: Float[np.ndarray, " v"],
    weight: Float[np.ndarray, " v"],
) -> Float[np.ndarray, " v"]:
    """Returns, for each vertex of a closed mesh, the weighted mean of the values over its surroundings
    (``SURROUNDINGS`` steps); about 0 where no weight is near. ``beside`` are its ``neighbours``."""
    both = blurred_over_mesh(np.stack([weight * values, weight], axis=1).astype(float), *beside, SURROUNDINGS)
    return both[:, 0] / np.maximum(both[:, 1], 1e-6)
