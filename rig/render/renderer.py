"""The renderer that an owner creates, passes in, and closes."""

from collections.abc import Sequence

import numpy as np
from jaxtyping import Float, Int, UInt8

from rig.mesh import Mesh
from rig.render.colour import UNLIT, Light, draw_colour
from rig.render.context import GlContext
from rig.render.depth import draw_depth
from rig.render.photograph import Gallery, Part, draw_photographs, draw_vertex_radiance
from rig.render.silhouettes import SilhouetteSet
from rig.rig import Rig


class Renderer:
    """Draws meshes as the cameras of a rig see them, lens distortion included. One thread of one process owns it.

    ``with Renderer.create() as renderer: ...``. Raises EglUnavailable where OpenGL cannot start, WrongThread where it
    is used elsewhere. Meshes are in the world frame, mm; images have row 0 on top. ``scale`` draws in the same views
    at another resolution (0.5: half the width).
    """

    def __init__(self, context: GlContext) -> None:
        self.context = context

    @classmethod
    def create(cls) -> "Renderer":
        return cls(GlContext())

    def __enter__(self) -> "Renderer":
        return self

    def __exit__(self, *_: object) -> None:
        self.close()

    def close(self) -> None:
        self.context.close()

    def silhouette_set(self, rig: Rig, faces: Int[np.ndarray, "f 3"], scale: float = 1.0) -> SilhouetteSet:
        """Returns masks and weighted XOR of one mesh topology in all cameras, made ready for many evaluations."""
        return SilhouetteSet(self.context, rig.scaled(scale) if scale != 1.0 else rig, faces)

    def depth(
        self, rig: Rig, vertices_world: Float[np.ndarray, "v 3"], faces: Int[np.ndarray, "f 3"], scale: float = 1.0
    ) -> dict[str, Float[np.ndarray, "_ _"]]:
        """Returns the depth along the optical axis (z in the camera frame, mm, float32) of the nearest surface; inf
        where none."""
        return draw_depth(self.context, rig.scaled(scale) if scale != 1.0 else rig, vertices_world, faces)

    def colour(
        self, rig: Rig, mesh: Mesh, scale: float = 1.0, *, samples: int = 4, light: Light = UNLIT
    ) -> dict[str, UInt8[np.ndarray, "_ _ 4"]]:
        """Returns the mesh with its vertex colours (grey where it has none), antialiased: RGB, and coverage as
        alpha."""
        return draw_colour(self.context, rig.scaled(scale) if scale != 1.0 else rig, mesh, samples, light)

    def photograph(
        self, rig: Rig, parts: Sequence[Part], gallery: Gallery, *, samples: int = 4
    ) -> dict[str, Float[np.ndarray, "_ _ 4"]]:
        """Returns linear radiance of a painted, lit subject: RGB multiplied by coverage, and coverage (float32)."""
        return draw_photographs(self.context, rig, parts, gallery, samples)

    def vertex_radiance(self, part: Part, gallery: Gallery) -> Float[np.ndarray, "v 3"]:
        """Returns linear RGB of each vertex of a part, as photographed but without highlights (float32)."""
        return draw_vertex_radiance(self.context, part, gallery)
