"""Makes a cap that lies on the scalp, a swim or wig cap: the head's own surface, pushed out by the cap's thickness."""

from dataclasses import dataclass

import numpy as np
from jaxtyping import Float, Int

from rig.mesh import Mesh, vertex_normals
from rig.studio.scene.anatomy import Anatomy

# The edge: height above the ears' openings over depth in front of them (mm), behind to front. Ears stay free.
EDGE = np.array([(-200, -32), (-62, -28), (-38, 14), (-22, 40), (16, 42), (34, 50), (60, 62), (200, 70)], float)
SUNK_MM = 2.0  # of the edge below the skin
CREASED_MM = 22.0  # from the edge, over which folds fade
RIDGES = (11, 17, 29)  # folds around the head, added up


@dataclass(frozen=True, slots=True)
class TightCap:
    """Describes a cap: its albedo (linear RGB), its thickness, how high the folds near its edge stand, how much darker
    they are, and whether it shines as silicone does."""

    colour: tuple[float, float, float]
    thickness_mm: float = 1.0
    folds_mm: float = 0.0
    creases: float = 0.0
    glossy: bool = True


def lay_cap(
    head: Mesh, body: Anatomy, cap: TightCap, rng: np.random.Generator
) -> tuple[Float[np.ndarray, "v 3"], Int[np.ndarray, "f 3"], Float[np.ndarray, "v 3"]]:
    """Lays a cap on a head (head frame, mm). Returns its vertices, triangles, and albedo (linear RGB) by vertex."""
    above = above_edge_mm(head.vertices, body)
    faces = head.faces[(above[head.faces] > 0.0).any(axis=1)]
    rows, corners = np.unique(faces, return_inverse=True)
    out, normals = head.vertices[rows] - body.ears, vertex_normals(head.vertices, head.faces)[rows]
    turn, above = np.arctan2(out[:, 0], out[:, 2]), above[rows]
    waves = sum(np.sin(count * turn + rng.uniform(0.0, 2.0 * np.pi)) for count in RIDGES) / len(RIDGES)
    fold = np.clip(waves, 0.0, 1.0) * np.exp(-np.maximum(above, 0.0) / CREASED_MM)
    height = np.where(above > 0.0, cap.thickness_mm + cap.folds_mm * fold, -SUNK_MM)
    shade = 1.0 - cap.creases * (np.abs(waves) * np.exp(-np.maximum(above, 0.0) / (2.0 * CREASED_MM)))
    albedo = np.array(cap.colour) * shade[:, None]
    return head.vertices[rows] + height[:, None] * normals, corners.reshape(-1, 3), albedo


def above_edge_mm(vertices: Float[np.ndarray, "v 3"], body: Anatomy) -> Float[np.ndarray, " v"]:
    """Returns how far above the edge of a cap each vertex of a head lies (mm); negative where the cap ends lower."""
    relative = (vertices - body.ears) / body.unit
    return (relative[:, 1] - np.interp(relative[:, 2], EDGE[:, 0], EDGE[:, 1])) * body.unit
