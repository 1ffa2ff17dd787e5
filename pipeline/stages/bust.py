"""Makes the bust: head, hair and clothes as one closed surface, in the photographs' colours."""

from dataclasses import dataclass

import numpy as np
from jaxtyping import Bool, Float, Int, UInt8

from pipeline.compute.threads import map_in_threads
from pipeline.detail.hair_shell import MIN_COVERED, HairShell, move_to_hair
from pipeline.fusion.fusion import BustSurface, DepthSurface, finish_bust, fuse
from pipeline.fusion.hair import correct_parts, find_silent_hair, remove_specks
from pipeline.fusion.signed_distance import NoSurface
from pipeline.fusion.skin import HeadSkin
from pipeline.geometry.nearest import PointTree, nearest
from pipeline.geometry.projection import depth_maps
from pipeline.head_model.model import HeadModel
from pipeline.head_model.regions import pinnae, scalp
from pipeline.part_labels.codes import Part
from pipeline.part_labels.votes import PartVotes, part_shares
from pipeline.stages.context import ReconstructionContext
from pipeline.stages.depth import Depth
from pipeline.stages.part_labels import PartLabels
from pipeline.stages.recorder import Staged
from pipeline.stages.refined_head import RefinedHead
from pipeline.stages.views import Views
from pipeline.texturing.layout.uv_unwrap import Atlas
from pipeline.texturing.paint import find_layout, paint_charts, paint_head
from pipeline.texturing.vertex_colours import Shown, colour_vertices
from rig.capture import Capture
from rig.mesh import Mesh
from rig.messages.message import compose

# Of the face: the message is for an operator who takes the bust for a measurement.
MAX_GUESSED_SHARE = 0.1
OFF_HEAD_MM = 8.0  # long hair before a neck; skin's own surface lies within its deviation of the head
FACE_REACH_MM = 10.0  # from the head's face: what lies farther in front of it is hair, a hand or a garment


@dataclass(frozen=True, slots=True, eq=False)
class ShapedBust:
    """Holds the surface of the bust. ``face_silent_share`` (0 to 1) is the fraction of the bust's face vertices that no
    depth map supports. ``guessed_share`` is the fraction that neither a depth map nor the refined head measured.
    ``likely_part`` is the part label of each vertex; unseen vertices have the most likely label."""

    surface: BustSurface
    likely_part: UInt8[np.ndarray, " v"]
    face_silent_share: float
    guessed_share: float


@dataclass(frozen=True, slots=True, eq=False)
class Bust:
    """Holds the closed surface of head, hair and clothes, with its colours (sRGB). ``views`` is the number of images
    that coloured each vertex; 0 means a colour interpolated from neighbours. ``spacing_mm`` is the grid's spacing.
    ``atlas`` is the texture if the settings request GLB."""

    shaped: ShapedBust
    normals: Float[np.ndarray, "v 3"]
    colours: UInt8[np.ndarray, "v 3"]
    views: UInt8[np.ndarray, " v"]
    spacing_mm: float
    atlas: Atlas | None = None

    @property
    def surface(self) -> BustSurface:
        """Returns the surface without its colours."""
        return self.shaped.surface

    @property
    def mesh_world(self) -> Mesh:
        """Returns the surface as a mesh, world frame, mm."""
        return self.surface.mesh_world


def fuse_depth(
    context: ReconstructionContext, views: Views, head_world: Mesh, labels: PartLabels, depth: Depth
) -> Staged[DepthSurface | None]:
    """Fuses the depth maps to one closed surface. Regions that no camera sees follow the fitted head. Long hair without
    measured depth becomes a shell inside its outlines.

    Returns None if the settings request only the head. Returns None with the warning ``no-bust`` if the depth maps do
    not determine a surface.
    """
    settings = context.settings
    if settings.outputs.surface == "head":
        return Staged(None)
    parts = None if depth.votes is None else correct_parts(depth.votes, head_world, stubble=False)
    solid = map_in_threads(lambda k: remove_specks(depth.maps[k], labels.maps, context.rig), len(depth.maps))
    hair, maps, scatter = find_silent_hair(solid, labels.maps, parts, context.rig)
    try:
        surface = fuse(
            maps,
            views.silhouettes,
            context.rig,
            head_world,
            bias=depth.window_bias,
            spacing_mm=settings.bust.spacing_mm,
            report=context.progress,
            hair=hair,
            scatter=scatter,
            ears=[] if parts is None else bare_ears(context.model, head_world, parts),
        )
    except NoSurface as reason:
        return Staged(None, [compose("no-bust", reason=reason.message)])
    return Staged(surface, surface.warnings)


def bare_ears(model: HeadModel, head_world: Mesh, votes: PartVotes) -> list[Bool[np.ndarray, " v"]]:
    """Returns a vertex mask of each ear that the part labels show as skin rather than hair."""
    shares, left = part_shares(votes, head_world.vertices), model.vertices(np.zeros(0))[:, 0] > 0.0
    bare = shares[:, Part.SKIN.channel] - shares[:, Part.HAIR.channel]
    return [ear for side in (left, ~left) if bare[ear := pinnae(model) & side].sum() > 0.0]


def shape_bust(
    context: ReconstructionContext,
    views: Views,
    votes: PartVotes | None,
    refined: RefinedHead,
    fused: DepthSurface | None,
) -> Staged[ShapedBust | None]:
    """Combines the fused surface with the final head, extends hair to its outlines, and repairs bad triangles. Returns
    None if ``fused`` is None. Warns ``bust-guessed`` if neither depth nor head measured most of the face."""
    if fused is None:
        return Staged(None)
    head = HeadSkin(refined.mesh_world, refined.deviation_mm)
    surface = finish_bust(fused, votes, head, views.silhouettes, context.rig)
    mesh, face = surface.mesh_world, context.model.levels["full"].face_region
    far, near = nearest(PointTree.of(head.mesh_world.vertices), mesh.vertices)
    on_face = (far < FACE_REACH_MM) & face[near]
    silent = ~surface.seen[on_face]
    measured = np.zeros(len(face), bool) if refined.displaced is None else refined.displaced.observed
    guessed = silent & ~measured[near[on_face]]
    likely = _likely_parts(surface, far, near, context.model)
    shaped = ShapedBust(surface, likely, _share(silent), _share(guessed))
    doubtful = shaped.guessed_share > MAX_GUESSED_SHARE
    return Staged(shaped, [compose("bust-guessed", share=shaped.guessed_share)] if doubtful else [])


def _share(chosen: Bool[np.ndarray, " n"]) -> float:
    return float(chosen.mean()) if len(chosen) else 0.0


def colour_bust(
    context: ReconstructionContext,
    views: Views,
    labels: PartLabels,
    shaped: ShapedBust | None,
    coloured: Capture,
    head_axes: Float[np.ndarray, "3 3"],
) -> Staged[Bust | None]:
    """Colours the bust from the photographs of ``coloured``; ``head_axes`` are as in ``paint_charts``."""
    if shaped is None:
        return Staged(None)
    settings, rig, mesh = context.settings, context.rig, shaped.surface.mesh_world
    normals, depths = mesh.normals(), depth_maps(rig, mesh)
    likely, seen = shaped.likely_part, shaped.surface.seen
    best = "glb" in settings.outputs.formats
    shown = Shown(
        likely, lambda camera, rows: labels.shares(camera, mesh.vertices[rows]), measured=seen, best_views=best
    )
    colours = colour_vertices(mesh, coloured, views.silhouettes, rig, depths, settings=settings.texture, shown=shown)
    atlas = paint_charts(mesh, normals, colours, head_axes, np.flatnonzero(seen), settings.outputs.texture_size)
    return Staged(Bust(shaped, normals, colours.colours, colours.views, settings.bust.spacing_mm, atlas))


def _likely_parts(
    surface: BustSurface, far_mm: Float[np.ndarray, " v"], near: Int[np.ndarray, " v"], model: HeadModel
) -> UInt8[np.ndarray, " v"]:
    """Returns the most likely part label of each vertex, which selects the colour of unseen vertices. ``HAIR`` is the
    whole scalp, bald or not, and everything far from the head; ``CLOTHES`` lie beyond the head's open border.
    ``far_mm`` and ``near`` are the distance to the nearest vertex of the head, and its index."""
    part, unseen = surface.part.copy(), surface.part == Part.UNSEEN
    part[unseen] = Part.SKIN
    part[scalp(model)[near] | (unseen & (far_mm > OFF_HEAD_MM))] = Part.HAIR
    part[unseen & model.levels["full"].boundary[near]] = Part.CLOTHES
    return part


@dataclass(frozen=True, slots=True, eq=False)
class HairyHead:
    """Holds the head with vertices moved outwards to the hair, its colours (sRGB), the number of images that coloured
    each vertex, and its texture if the settings request one."""

    shell: HairShell
    normals: Float[np.ndarray, "v 3"]
    colours: UInt8[np.ndarray, "v 3"]
    views: UInt8[np.ndarray, " v"]
    atlas: Atlas | None = None


def push_out_hair(
    context: ReconstructionContext, views: Views, refined: RefinedHead, bust: Bust | None, coloured: Capture
) -> Staged[HairyHead | None]:
    """Moves the final head's vertices outwards to the bust's hair, and colours them from the photographs of
    ``coloured``. Returns None without a bust, or if the settings do not request hair. Warns ``hair-beyond-head`` if the
    head's vertices do not reach the hair."""
    settings, rig = context.settings, context.rig
    if bust is None or settings.outputs.surface != "hair":
        return Staged(None)
    shell = move_to_hair(refined.mesh_world, bust.mesh_world, bust.surface.part)
    mesh = Mesh(shell.vertices_world, refined.mesh_world.faces)
    normals, depths, layout = mesh.normals(), depth_maps(rig, mesh), find_layout(context.model, settings)[0]
    around = None if layout is None else layout.around
    colours = colour_vertices(mesh, coloured, views.silhouettes, rig, depths, settings=settings.texture, around=around)
    atlas = paint_head(layout, mesh, colours, context.model.levels["full"].face_region, settings)
    made = HairyHead(shell, normals, colours.colours, colours.views, atlas)
    beyond = shell.covered < MIN_COVERED
    return Staged(made, [compose("hair-beyond-head", share=shell.covered)] if beyond else [])
