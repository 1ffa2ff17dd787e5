"""Provides the renderer, which its owner creates, passes on, and closes."""

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
    """Draws meshes as the cameras of a rig see them, lens distortion included. It belongs to one thread of one process.

    ``with Renderer.create() as renderer: ...``. Raises EglUnavailable if OpenGL cannot start, and WrongThread if it is
    used in another thread. Meshes are in the world frame, mm; images have row 0 on top. ``scale`` draws the same views
    at another resolution (0.5: half the width).
    """

    def __init__(self, context: GlContext) -> None:
        self.context = context

    @classmethod
    def create(cls) -> "Renderer":
        """Returns a new renderer for this thread. Raises EglUnavailable if OpenGL cannot start."""
        return cls(GlContext())

    def __enter__(self) -> "Renderer":
        return self

    def __exit__(self, *_: object) -> None:
        self.close()

    def close(self) -> None:
        """Frees the renderer. Raises WrongThread in another thread."""
        self.context.close()

    def silhouette_set(self, rig: Rig, faces: Int[np.ndarray, "f 3"], scale: float = 1.0) -> SilhouetteSet:
        """Prepares many evaluations of one mesh topology in all cameras: its masks, and their weighted XOR with given
        ones."""
        return SilhouetteSet(self.context, rig.scaled(scale) if scale != 1.0 else rig, faces)

    def depth(
        self, rig: Rig, vertices_world: Float[np.ndarray, "v 3"], faces: Int[np.ndarray, "f 3"], scale: float = 1.0
    ) -> dict[str, Float[np.ndarray, "_ _"]]:
        """Returns the depth of the nearest surface along the optical axis (z in the camera frame, mm, float32) by
        camera; inf where there is none."""
        return draw_depth(self.context, rig.scaled(scale) if scale != 1.0 else rig, vertices_world, faces)

    def colour(
        self, rig: Rig, mesh: Mesh, scale: float = 1.0, *, samples: int = 4, light: Light = UNLIT
    ) -> dict[str, UInt8[np.ndarray, "_ _ 4"]]:
        """Draws the mesh with its vertex colours (grey if it has none), antialiased. Returns RGB, and coverage as
        alpha, by camera."""
        return draw_colour(self.context, rig.scaled(scale) if scale != 1.0 else rig, mesh, samples, light)

    def photograph(
        self, rig: Rig, parts: Sequence[Part], gallery: Gallery, *, samples: int = 4
    ) -> dict[str, Float[np.ndarray, "_ _ 4"]]:
        """Draws a painted, lit subject. Returns its linear radiance by camera: RGB multiplied by coverage, and coverage
        (float32)."""
        return draw_photographs(self.context, rig, parts, gallery, samples)

    def vertex_radiance(self, part: Part, gallery: Gallery) -> Float[np.ndarray, "v 3"]:
        """Returns the linear RGB (float32) of each vertex of a part, as photographed but without highlights."""
        return draw_vertex_radiance(self.context, part, gallery)
