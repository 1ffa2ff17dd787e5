"""Draws a relief of skin at random, and gives it to a head as geometry.

Real skin is crossed by furrows 20 to 100 um deep and 0.5 to 3 mm apart. Here the relief is a sum of plane waves in head
coordinates, so its height is known at every point.
"""

from dataclasses import dataclass
from typing import Any, cast

import numpy as np
from jaxtyping import Float
from trimesh.remesh import subdivide

from rig.mesh import Mesh, vertex_normals

WAVES = 160
SHORTEST_MM, LONGEST_MM = 0.5, 3.0
EDGE_MM = 0.16  # of the divided triangles: three to the shortest wave
FADE = 0.75  # share of the radius within which the relief has its full height
CHUNK = 20_000


@dataclass(frozen=True, slots=True, eq=False)
class SkinRelief:
    """Holds a relief: plane waves (rad/mm, rad, mm) in the head frame, within ``radius_mm`` of the ``centres``."""

    vectors: Float[np.ndarray, "w 3"]
    phases: Float[np.ndarray, " w"]
    amplitudes_mm: Float[np.ndarray, " w"]
    centres: Float[np.ndarray, "c 3"]
    radius_mm: float

    def share(self, places: Float[np.ndarray, "n 3"]) -> Float[np.ndarray, " n"]:
        """Returns the strength of the relief at points of the head (mm): 1 inside, 0 beyond the radius."""
        off = np.linalg.norm(places[:, None] - self.centres[None], axis=2).min(axis=1) / self.radius_mm
        inside = np.clip((1.0 - off) / (1.0 - FADE), 0.0, 1.0)
        return inside * inside * (3.0 - 2.0 * inside)

    def heights_mm(self, places: Float[np.ndarray, "n 3"]) -> Float[np.ndarray, " n"]:
        """Returns the height at points of the head (mm), along its normals."""
        chunks = np.array_split(places, len(places) // CHUNK + 1)
        parts = [np.sin(chunk @ self.vectors.T + self.phases) @ self.amplitudes_mm for chunk in chunks]
        return np.concatenate(parts) * self.share(places)


def draw_relief(
    rng: np.random.Generator, centres: Float[np.ndarray, "c 3"], radius_mm: float, slope: float
) -> SkinRelief:
    """Draws a relief of waves in all directions with equal power in each octave of slope. ``slope`` is its root mean
    square."""
    directions = rng.standard_normal((WAVES, 3))
    directions /= np.linalg.norm(directions, axis=1, keepdims=True)
    lengths_mm = np.exp(rng.uniform(np.log(SHORTEST_MM), np.log(LONGEST_MM), WAVES))
    amplitudes_mm = slope * np.sqrt(3.0 / WAVES) * lengths_mm / (2 * np.pi)  # two thirds of a wave's slope is seen
    vectors = directions * (2 * np.pi / lengths_mm)[:, None]
    return SkinRelief(vectors, rng.uniform(0, 2 * np.pi, WAVES), amplitudes_mm, centres, radius_mm)


def relieved(head: Mesh, relief: SkinRelief) -> Mesh:
    """Divides the triangles of a head (head frame, mm) where it has a relief, and moves their corners along the
    normals."""
    places, attributes = head.vertices, {"normals": vertex_normals(head.vertices, head.faces)}
    near = (relief.share(places) > 0)[head.faces].any(axis=1)
    inner, outer = head.faces[near], head.faces[~near]
    while len(inner) and np.median(np.linalg.norm(places[inner[:, 0]] - places[inner[:, 1]], axis=1)) > EDGE_MM:
        places, inner, attributes = cast(Any, subdivide)(places, inner, vertex_attributes=attributes)
    normals = attributes["normals"] / np.linalg.norm(attributes["normals"], axis=1, keepdims=True)
    return Mesh(places + relief.heights_mm(places)[:, None] * normals, np.concatenate([outer, inner]))
