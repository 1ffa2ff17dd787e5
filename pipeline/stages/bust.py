"""All that the cameras see as one closed surface, in the photographs' colours."""

from dataclasses import dataclass

import numpy as np
from jaxtyping import Float, UInt8

from pipeline.fusion.fusion import BustSurface, fuse
from pipeline.fusion.signed_distance import NoSurface
from pipeline.fusion.skin import part_of
from pipeline.geometry.raster import depth_maps
from pipeline.stages.context import ReconstructionContext
from pipeline.stages.depth import Depth
from pipeline.stages.recorder import Staged, stage
from pipeline.stages.refined_head import RefinedHead
from pipeline.stages.views import Views
from pipeline.texturing.vertex_colours import texture
from rig.capture import Capture
from rig.mesh import Mesh
from rig.messages.message import compose


@dataclass(frozen=True, slots=True, eq=False)
class Bust:
    """Holds the closed surface of everything that the cameras see, with its colours (sRGB). ``views``: how many images
    coloured each vertex; 0 if it was filled from its neighbours."""

    surface: BustSurface
    normals: Float[np.ndarray, "v 3"]
    colours: UInt8[np.ndarray, "v 3"]
    views: UInt8[np.ndarray, " v"]
    spacing_mm: float

    @property
    def mesh_world(self) -> Mesh:
        return self.surface.mesh_world


@stage("bust")
def fuse_bust(
    context: ReconstructionContext, views: Views, depth: Depth, refined: RefinedHead, coloured: Capture
) -> Staged[Bust | None]:
    """Fuses the depth maps to one closed mesh, coloured from the photographs of ``coloured``.

    Returns None if the settings ask for the head only, and None with the warning ``no-bust`` if the depth maps do not
    determine a surface.
    """
    settings, rig, displaced = context.settings, context.rig, refined.displaced
    if settings.outputs.surface == "head":
        return Staged(None)
    try:
        surface = fuse(
            depth.maps,
            views.silhouettes,
            rig,
            refined.mesh_world,
            votes=depth.votes,
            bias=depth.window_bias,
            settings=settings.bust,
            head_skin_world=None if displaced is None else part_of(refined.mesh_world, displaced.observed),
            report=context.progress,
        )
    except NoSurface as reason:
        return Staged(None, [compose("no-bust", reason=reason.message)])
    mesh = surface.mesh_world
    normals, depths = mesh.normals(), depth_maps(rig, mesh)
    colours = texture(mesh, normals, coloured, views.silhouettes, rig, depths, settings=settings.texture)
    return Staged(Bust(surface, normals, colours.colours, colours.views, settings.bust.spacing_mm), surface.warnings)
