"""What GLB, USDZ and OBJ files of heads are made of: meshes by name with colours, texture and shapes, and the points
that they turn about."""

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

    ``source`` says which vertex of the mesh each coordinate belongs to, and ``faces`` are the triangles of coordinates;
    without them there is a coordinate a vertex. With a normal map (PNG, linear, +Y up), ``tangents`` are the tangents
    to which it refers, with the signs of the bitangents. ``specular`` is the strength of mirrored light, the alpha of a
    PNG.
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
    """Holds a mesh (mm, head frame, unturned; sRGB colours), its unit normals if they are not those of its triangles,
    and its displacements by name (mm, at weight 1) with the weights that it is shown with.

    ``pivot`` names the point that the part turns with. ``rows`` says which vertices of a file it has.
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
    """Holds parts, the points that they turn about (mm, by name; none, or ``neck`` among them), and rotations about
    some of them."""

    parts: Sequence[Part]
    pivots_mm: Mapping[str, Float[np.ndarray, " 3"]] = field(default_factory=dict)
    turns: Mapping[str, Float[np.ndarray, "3 3"]] = field(default_factory=dict)

    def about(self, part: Part) -> tuple[Float[np.ndarray, "v 3"], RigidTransform]:
        """Returns the vertices of a part relative to the point that it turns about, and where that point lies and how
        it is turned (mm)."""
        pivot = np.zeros(3) if part.pivot == NECK else self.pivots_mm[part.pivot]
        return part.mesh.vertices - pivot, RigidTransform(self.turns.get(part.pivot, np.eye(3)), pivot)


def quaternion(rotation: Float[np.ndarray, "3 3"]) -> Float[np.ndarray, " 4"]:
    """Returns a rotation as a unit quaternion x, y, z, w."""
    vector = vector_from_rotation(rotation)
    angle = float(np.linalg.norm(vector))
    return np.append(vector * (0.5 * np.sinc(angle / (2.0 * np.pi))), np.cos(0.5 * angle))
