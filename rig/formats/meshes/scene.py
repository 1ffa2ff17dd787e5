"""Defines the content of GLB, USDZ and OBJ files of heads: named meshes with colours, texture and shapes, and their
pivots."""

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
    """Holds a texture: coordinates (from the image's upper left corner, v downwards) and the encoded image.

    ``source`` is the mesh vertex of each coordinate, and ``faces`` are the triangles of coordinates; without them each
    vertex has one coordinate. A normal map (PNG, linear, +Y up) refers to ``tangents``, which hold the signs of the
    bitangents. ``specular`` is the strength of mirrored light, the alpha of a PNG.
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
    """Holds a mesh (mm, head frame, not rotated; sRGB colours). It may have unit normals other than its triangles', and
    displacements by name (mm, at weight 1) with the weights at which it is shown.

    ``pivot`` names the point with which the part turns. ``rows`` are the vertices of a file that it consists of.
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
        """Returns the normals of the vertices."""
        return self.mesh.normals() if self.normals is None else self.normals


@dataclass(frozen=True, slots=True, eq=False)
class Scene:
    """Holds parts, their pivots (mm, by name; none, or ``neck`` among them), and rotations about some of them."""

    parts: Sequence[Part]
    pivots_mm: Mapping[str, Float[np.ndarray, " 3"]] = field(default_factory=dict)
    turns: Mapping[str, Float[np.ndarray, "3 3"]] = field(default_factory=dict)

    def about(self, part: Part) -> tuple[Float[np.ndarray, "v 3"], RigidTransform]:
        """Returns the vertices of a part relative to its pivot, and the pivot's position (mm) and rotation."""
        pivot = np.zeros(3) if part.pivot == NECK else self.pivots_mm[part.pivot]
        return part.mesh.vertices - pivot, RigidTransform(self.turns.get(part.pivot, np.eye(3)), pivot)


def quaternion(rotation: Float[np.ndarray, "3 3"]) -> Float[np.ndarray, " 4"]:
    """Returns a rotation as a unit quaternion x, y, z, w."""
    vector = vector_from_rotation(rotation)
    angle = float(np.linalg.norm(vector))
    return np.append(vector * (0.5 * np.sinc(angle / (2.0 * np.pi))), np.cos(0.5 * angle))
