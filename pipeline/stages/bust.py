"""Makes the bust: all that the cameras see as one closed surface, in the photographs' colours."""

from dataclasses import dataclass

import numpy as np
from jaxtyping import Float, UInt8

from pipeline.detail.hair_shell import MIN_COVERED, HairShell, hair_shell
from pipeline.fusion.fusion import BustSurface, DepthSurface, finished, fuse
from pipeline.fusion.signed_distance import NoSurface
from pipeline.fusion.silent_hair import find_silent_hair
from pipeline.fusion.skin import measured_skin
from pipeline.geometry.nearest import PointTree, nearest
from pipeline.geometry.raster import depth_maps
from pipeline.stages.context import ReconstructionContext
from pipeline.stages.depth import Depth
from pipeline.stages.part_labels import PartLabels
from pipeline.stages.recorder import Staged
from pipeline.stages.refined_head import RefinedHead
from pipeline.stages.views import Views
from pipeline.texturing.vertex_colours import texture
from rig.capture import Capture
from rig.mesh import Mesh, vertex_normals
from rig.messages.message import compose


@dataclass(frozen=True, slots=True, eq=False)
class Bust:
    """Holds the closed surface of everything that the cameras see, with its colours (sRGB). ``views`` is the number of
    images that coloured each vertex; 0 if its colour was filled from its neighbours. ``spacing_mm`` is the grid's
    spacing."""

    surface: BustSurface
    normals: Float[np.ndarray, "v 3"]
    colours: UInt8[np.ndarray, "v 3"]
    views: UInt8[np.ndarray, " v"]
    spacing_mm: float

    @property
    def mesh_world(self) -> Mesh:
        """Returns the surface as a mesh, world frame, mm."""
        return self.surface.mesh_world


def fuse_depth(
    context: ReconstructionContext, views: Views, head_world: Mesh, labels: PartLabels, depth: Depth
) -> Staged[DepthSurface | None]:
    """Fuses the depth maps to one closed surface; where no camera sees the subject, the fitted head is used,
    and where long hair has hardly any depth, a shell inside its outlines.

    Returns None if the settings ask for the head only. Returns None with the warning ``no-bust`` if the depth maps do
    not determine a surface.
    """
    settings = context.settings
    if settings.outputs.surface == "head":
        return Staged(None)
    hair, maps = find_silent_hair(depth.maps, labels.maps, depth.votes, context.rig, head_world)
    try:
        surface = fuse(
            maps,
            views.silhouettes,
            context.rig,
            head_world,
            bias=depth.window_bias,
            settings=settings.bust,
            report=context.progress,
            hair=hair,
        )
    except NoSurface as reason:
        return Staged(None, [compose("no-bust", reason=reason.message)])
    return Staged(surface, surface.warnings)


def shape_bust(
    context: ReconstructionContext, views: Views, depth: Depth, refined: RefinedHead, fused: DepthSurface | None
) -> Staged[BustSurface | None]:
    """Moves the fused surface to the delivered head where both show the same skin, and hair to its outlines, and
    removes self-intersections. Returns None for None."""
    if fused is None:
        return Staged(None)
    displaced = refined.displaced
    skin = None
    if displaced is not None:
        skin = measured_skin(refined.mesh_world, refined.deviation_mm, displaced.observed, displaced.outlined)
    return Staged(finished(fused, depth.votes, skin, views.silhouettes, context.rig))


def colour_bust(
    context: ReconstructionContext, views: Views, surface: BustSurface | None, coloured: Capture
) -> Staged[Bust | None]:
    """Colours the bust from the photographs of ``coloured``. Returns None without a surface."""
    if surface is None:
        return Staged(None)
    settings, rig, mesh = context.settings, context.rig, surface.mesh_world
    normals, depths = mesh.normals(), depth_maps(rig, mesh)
    colours = texture(mesh, normals, coloured, views.silhouettes, rig, depths, settings=settings.texture)
    return Staged(Bust(surface, normals, colours.colours, colours.views, settings.bust.spacing_mm))


@dataclass(frozen=True, slots=True, eq=False)
class HairyHead:
    """Holds the head pushed out to its hair, with the bust's colours (sRGB) and views."""

    shell: HairShell
    normals: Float[np.ndarray, "v 3"]
    colours: UInt8[np.ndarray, "v 3"]
    views: UInt8[np.ndarray, " v"]


def push_out_hair(context: ReconstructionContext, refined: RefinedHead, bust: Bust | None) -> Staged[HairyHead | None]:
    """Pushes the delivered head out to the bust's hair, if the settings ask for it. Returns None otherwise, and without
    a bust. Warns ``hair-beyond-head`` where the head's vertices do not reach the hair."""
    if bust is None or context.settings.outputs.surface != "hair":
        return Staged(None)
    head, mesh = refined.mesh_world, bust.mesh_world
    shell = hair_shell(head, mesh, bust.surface.part)
    near = nearest(PointTree.of(mesh.vertices), shell.vertices_world)[1]
    made = HairyHead(shell, vertex_normals(shell.vertices_world, head.faces), bust.colours[near], bust.views[near])
    beyond = shell.covered < MIN_COVERED
    return Staged(made, [compose("hair-beyond-head", share=shell.covered)] if beyond else [])
