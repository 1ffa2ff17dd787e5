"""Defines the content of GLB, USDZ and OBJ files: named meshes with colours, textures, morph targets and pivots."""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field

import numpy as np
from jaxtyping import Float, Int

from rig.geometry import RigidTransform, vector_from_rotation
from rig.mesh import Mesh

NECK = "neck"
Shapes = Mapping[str, Float[np.ndarray, "v 3"]]


@dataclass(frozen=True, slots=True, eq=False)
class Skin:
    """Holds an encoded texture image and texture coordinates, from the image's upper left corner with v downwards.

    ``source`` is the mesh vertex of each texture coordinate, and ``faces`` holds triangles of texture coordinates.
    Without ``source`` and ``faces``, each vertex has one texture coordinate. A normal map (PNG, linear, +Y up) refers
    to ``tangents``, which include the signs of the bitangents. ``specular`` is the strength of specular reflection, as
    the alpha channel of a PNG.
    """

    uv: Float[np.ndarray, "n 2"]
    image: bytes
    mime: str = "image/jpeg"
    source: Int[np.ndarray, " n"] | None = None
    faces: Int[np.ndarray, "f 3"] | None = None
    normal_map: bytes | None = None
    tangents: Float[np.ndarray, "n 4"] | None = None
    specular: bytes | None = None


@dataclass(frozen=True, slots=True, eq=False)
class Part:
    """Holds a mesh (mm, head frame) before any rotation, with sRGB colours. Optional unit normals replace the normals
    of the triangles. Optional morph targets are displacements (mm, at weight 1) by name, with their initial weights.

    ``pivot`` names the point about which the part turns. ``rows`` lists the vertices of a file that form the part.
    """

    name: str
    mesh: Mesh
    normals: Float[np.ndarray, "v 3"] | None = None
    skin: Skin | None = None
    morphs: Shapes = field(default_factory=dict)
    weights: Mapping[str, float] = field(default_factory=dict)
    pivot: str = NECK
    rows: Sequence[int] | None = None

    def unit_normals(self) -> Float[np.ndarray, "v 3"]:
        """Returns the unit normals of the vertices."""
        return self.mesh.normals() if self.normals is None else self.normals


@dataclass(frozen=True, slots=True, eq=False)
class Scene:
    """Holds parts, pivots (mm, including ``neck``) by name, and rotations about some pivots."""

    parts: Sequence[Part]
    pivots_mm: Mapping[str, Float[np.ndarray, " 3"]] = field(default_factory=dict)
    turns: Mapping[str, Float[np.ndarray, "3 3"]] = field(default_factory=dict)

    def about(self, part: Part) -> tuple[Float[np.ndarray, "v 3"], RigidTransform]:
        """Returns the vertices (mm) of a part relative to its pivot, and the pivot's position (mm) and rotation."""
        pivot = np.zeros(3) if part.pivot == NECK else self.pivots_mm[part.pivot]
        return part.mesh.vertices - pivot, RigidTransform(self.turns.get(part.pivot, np.eye(3)), pivot)


def quaternion(rotation: Float[np.ndarray, "3 3"]) -> Float[np.ndarray, " 4"]:
    """Converts a rotation matrix to a unit quaternion x, y, z, w."""
    vector = vector_from_rotation(rotation)
    angle = float(np.linalg.norm(vector))
    return np.append(vector * (0.5 * np.sinc(angle / (2.0 * np.pi))), np.cos(0.5 * angle))
