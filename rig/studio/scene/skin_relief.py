"""Gives skin a known relief: waves of 0.5 to 3 mm, as true geometry, where cameras are near enough to see them.

Real skin is crossed by furrows 20 to 100 um deep and 0.5 to 3 mm apart. Here the relief is a sum of plane waves, a
function of the place on the head, so that its height is known at every point. The skin's triangles are divided finely
there, moved along the normals, and lit with the normals of the relief.
"""

from collections.abc import Mapping
from dataclasses import dataclass

import numpy as np
from jaxtyping import Float, Int

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
        """Returns how much of the relief there is at points of the head (mm): 1 inside, 0 beyond the radius."""
        off = np.linalg.norm(places[:, None] - self.centres[None], axis=2).min(axis=1) / self.radius_mm
        inside = np.clip((1.0 - off) / (1.0 - FADE), 0.0, 1.0)
        return inside * inside * (3.0 - 2.0 * inside)

    def heights_mm(self, places: Float[np.ndarray, "n 3"]) -> Float[np.ndarray, " n"]:
        """Returns the height at points of the head (mm), along its normals."""
        parts = [np.sin(chunk @ self.vectors.T + self.phases) @ self.amplitudes_mm for chunk in _chunks(places)]
        return np.concatenate([np.zeros(0), *parts]) * self.share(places)

    def slopes(self, places: Float[np.ndarray, "n 3"]) -> Float[np.ndarray, "n 3"]:
        """Returns the gradient of the height at points of the head. The slow fading towards the radius is left out."""
        scaled = self.amplitudes_mm[:, None] * self.vectors
        parts = [np.cos(chunk @ self.vectors.T + self.phases) @ scaled for chunk in _chunks(places)]
        return np.concatenate([np.zeros((0, 3)), *parts]) * self.share(places)[:, None]


def _chunks(places: Float[np.ndarray, "n 3"]) -> list[Float[np.ndarray, "_ 3"]]:
    return [places[start : start + CHUNK] for start in range(0, len(places), CHUNK)]


@dataclass(frozen=True, slots=True, eq=False)
class RelievedSkin:
    """Holds skin with its relief (head frame, mm). ``places`` are its points before the relief moved them; ``values``
    are interpolated from the values at the vertices."""

    vertices: Float[np.ndarray, "v 3"]
    faces: Int[np.ndarray, "f 3"]
    normals: Float[np.ndarray, "v 3"]
    places: Float[np.ndarray, "v 3"]
    values: Mapping[str, Float[np.ndarray, "v _"]]


def relieved(head: Mesh, relief: SkinRelief, values: Mapping[str, Float[np.ndarray, "v _"]]) -> RelievedSkin:
    """Divides the triangles of a head where it has a relief, and moves their corners to it. ``values`` are those of the
    head's vertices."""
    normals = vertex_normals(head.vertices, head.faces)
    table = np.concatenate([head.vertices, normals, *values.values()], axis=1)
    near = (relief.share(head.vertices) > 0)[head.faces].any(axis=1)
    inner, outer = head.faces[near], head.faces[~near]
    while len(inner) and _edge_mm(table, inner) > EDGE_MM:
        table, inner = _halved(table, inner)
    places, normals = table[:, :3], table[:, 3:6] / np.linalg.norm(table[:, 3:6], axis=1, keepdims=True)
    slopes = relief.slopes(places)
    slopes -= (slopes * normals).sum(axis=1, keepdims=True) * normals
    tilted = normals - slopes
    columns = np.cumsum([6, *(array.shape[1] for array in values.values())])
    return RelievedSkin(
        places + relief.heights_mm(places)[:, None] * normals,
        np.concatenate([outer, inner]),
        tilted / np.linalg.norm(tilted, axis=1, keepdims=True),
        places,
        {
            name: table[:, first : first + array.shape[1]]
            for first, (name, array) in zip(columns, values.items(), strict=False)
        },
    )


def _edge_mm(table: Float[np.ndarray, "v _"], faces: Int[np.ndarray, "f 3"]) -> float:
    return float(np.median(np.linalg.norm(table[faces[:, 0], :3] - table[faces[:, 1], :3], axis=1)))


def _halved(
    table: Float[np.ndarray, "v k"], faces: Int[np.ndarray, "f 3"]
) -> tuple[Float[np.ndarray, "w k"], Int[np.ndarray, "g 3"]]:
    """Divides every triangle into four at the middles of its edges."""
    edges = np.sort(np.concatenate([faces[:, [0, 1]], faces[:, [1, 2]], faces[:, [2, 0]]]), axis=1)
    key = edges[:, 0].astype(np.int64) * len(table) + edges[:, 1]
    _, first, which = np.unique(key, return_index=True, return_inverse=True)
    middles = 0.5 * (table[edges[first, 0]] + table[edges[first, 1]])
    ab, bc, ca = (len(table) + which).reshape(3, -1)
    a, b, c = faces.T
    corners = [(a, ab, ca), (ab, b, bc), (ca, bc, c), (ab, bc, ca)]
    return np.concatenate([table, middles]), np.concatenate([np.stack(f, axis=1) for f in corners])
