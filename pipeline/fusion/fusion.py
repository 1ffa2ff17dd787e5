"""Fuses the depth maps of all views into one closed surface.

A signed distance is computed on a grid (``signed_distance``), and its zero level becomes a mesh (``surface_nets``). The
vertices are moved to the depth maps (``refinement``) and to the fitted head (``skin``); hair is moved to its outlines
(``hair``). As the last step, flipped, folded or intersecting triangles are repaired (``untangling``)."""

from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass, replace

import numpy as np
from jaxtyping import Bool, Float, UInt8

from pipeline.compute.trace import traced
from pipeline.fusion.crossings import separate_coincidences
from pipeline.fusion.grid_kernels import component_of, compose_well
from pipeline.fusion.hair import (
    STRAND_SHARE,
    Places,
    correct_parts,
    extend_to_outlines,
    shell_deviation_mm,
    smooth_unresolved,
)
from pipeline.fusion.prior import below_head
from pipeline.fusion.refinement import (
    MAX_MM,
    Measured,
    SeenVertices,
    deviation_mm,
    refine_vertices,
    remove_islands,
    seen_deviation_mm,
)
from pipeline.fusion.signed_distance import HeadEars, Level, NoSurface, solve
from pipeline.fusion.skin import HeadSkin, combine_with_head
from pipeline.fusion.untangling import CLEAN, MeshFaults, mesh_faults, smooth_spots, topology_of
from pipeline.fusion.view_stack import silence_contradicted, stack_views
from pipeline.geometry.nearest import PointTree, nearest
from pipeline.geometry.surface_nets import surface_net
from pipeline.imaging.silhouette import Silhouette
from pipeline.part_labels.codes import Part
from pipeline.part_labels.votes import PartVotes, part_codes, part_shares
from pipeline.stereo.depth_map import DepthMap, WindowBias, subtract_bias
from pipeline.warnings import ReportWarning
from rig.mesh import Mesh, face_normals
from rig.messages.message import compose
from rig.progress import Progress
from rig.rig import Rig

TURNED_TO = 0.01  # steps from the surface at which a node that is turned over lies
CAP_STEPS = 0.5  # from the bust's end within which a vertex belongs to its cap
MIN_VIEWS = 3
HEAD_STRIDE = 7  # every seventh vertex of the fitted head says which piece is the subject
CONTRADICTED_TIMES, CONTRADICTED_SOFT = 3.0, 0.03  # of the views' median, and at most: soft masks that other programs
# publish lack 0.003 to 0.015 in every view, and no plate or mask is at fault
CONTRADICTED_WARNED = 0.002  # of a view's crop: what its outline leaves out and others see solid


@dataclass(frozen=True, slots=True, eq=False)
class BustSurface:
    """Holds the whole visible surface: one closed two-manifold piece that faces outwards. ``faults`` counts the bad
    triangles that remain after the repair, in single precision."""

    mesh_world: Mesh
    deviation_mm: Float[np.ndarray, " v"]  # standard deviation along the normal
    part: UInt8[np.ndarray, " v"]  # codes of ``Part``
    views: UInt8[np.ndarray, " v"]  # whose depth agrees with the place
    warnings: tuple[ReportWarning, ...] = ()
    faults: MeshFaults = CLEAN

    @property
    def seen(self) -> Bool[np.ndarray, " v"]:
        """Returns a mask of the vertices that at least one view sees."""
        return self.views > 0


@dataclass(frozen=True, slots=True, eq=False)
class DepthSurface:
    """Holds the surface fused from the depth maps, corrected for the matching bias; it may intersect itself."""

    mesh_world: Mesh
    safe_world: Float[np.ndarray, "v 3"]  # places (mm) with which the mesh cannot cross itself
    measured: Measured
    warnings: tuple[ReportWarning, ...]
    capped: Bool[np.ndarray, " v"]  # vertices of the cut that ends the bust
    scatter: float  # how far (0 to 1) the depth of hair is noise
    shell_deviation_mm: float | None = None  # of hair that is a guess inside its outlines; None without such hair


def fuse(
    depth_maps: Sequence[DepthMap],
    silhouettes: Mapping[str, Silhouette],
    rig: Rig,
    head_world: Mesh | None,
    *,
    bias: WindowBias,
    spacing_mm: float,
    report: Progress,
    hair: Places | None = None,
    scatter: float = 0.0,
    ears: Sequence[Bool[np.ndarray, " h"]] = (),
) -> DepthSurface:
    """Fuses the depth maps to one closed surface.

    Args:
        depth_maps: one for each view; maps without any known depth are left out.
        silhouettes: by camera, at least for the depth maps' cameras.
        rig: the cameras as calibrated, world frame.
        head_world: the fitted head, closed except at its neck (mm); None if there is none.
        bias: of the matching windows.
        spacing_mm: distance of the vertices.
        report: called with the stage's progress.
        hair: long hair without measured depth; None if there is none.
        scatter: noise fraction (0 to 1) of the depth of hair.
        ears: vertices of each bare ear of the head, which replaces the depth if few views agree.

    Raises:
        NoSurface: fewer than three views have any depth, or they contradict each other.
    """
    maps = [depth_map for depth_map in depth_maps if depth_map.known.any()]
    if len(maps) < MIN_VIEWS:
        raise NoSurface(compose("depth-in-too-few-views", count=len(maps), needed=MIN_VIEWS))
    views, contradicted = silence_contradicted(stack_views(maps, silhouettes, rig))
    report("bust", 0.1)
    agreed = np.median(np.concatenate([depth_map.views[depth_map.known] for depth_map in maps]))
    few = agreed <= MIN_VIEWS and len(ears) > 0
    taken = HeadEars.of(head_world, ears, views) if few and head_world is not None else None
    level, cut = solve(maps, views, head_world, spacing_mm, hair, taken)
    report("bust", 0.6)
    net, safe = closed_net(level, head_world)
    report("bust", 0.8)
    mesh, measured = refine_vertices(net, views, spacing_mm)
    capped = cut.distance_mm(mesh.vertices) > -CAP_STEPS * spacing_mm
    measured = remove_islands(mesh, replace(measured, views=np.where(capped, 0, measured.views).astype(np.uint8)))
    names = [depth_map.camera.name for depth_map in maps]
    warnings = tuple(mask_warnings(names, contradicted))
    straight = subtract_bias(mesh, measured.views > 0, bias)
    shell_mm = None if hair is None else shell_deviation_mm(hair, views)
    return DepthSurface(straight, safe, measured, warnings, capped, scatter, shell_mm)


@traced
def finish_bust(
    surface: DepthSurface,
    votes: PartVotes | None,
    head: HeadSkin | None,
    silhouettes: Mapping[str, Silhouette],
    rig: Rig,
) -> BustSurface:
    """Combines the surface with the head and with the outlines of hair, removes self-intersections, and labels its
    parts.

    Args:
        surface: from the depth maps.
        votes: part label of each point; None counts all seen points as skin.
        head: the delivered head with its deviation; None if there is none.
        silhouettes: by camera.
        rig: the cameras as calibrated, world frame.
    """
    mesh, measured = surface.mesh_world, surface.measured
    seen = measured.views > 0
    seen_vertices = SeenVertices.of(mesh.vertices, seen)
    shares, shown = np.tile([1.0, 0.0, 0.0], (len(seen), 1)), np.full(len(seen), Part.SKIN, np.uint8)
    if votes is not None:
        shown = part_codes(votes, mesh.vertices)
        shares = part_shares(votes if head is None else correct_parts(votes, head.mesh_world), mesh.vertices)
    skin, moved_mm = shares[:, Part.SKIN.channel], np.zeros(len(seen))
    strands, neck = surface.scatter * shares[:, Part.HAIR.channel], np.zeros(len(seen))
    clothes, noise_mm = shares[:, Part.CLOTHES.channel], seen_deviation_mm(measured)
    if head is not None:
        mesh = combine_with_head(mesh, seen * skin, head, noise_mm, seen_vertices, shown == Part.HAIR)
        neck[seen] = skin[seen] * below_head(head.mesh_world, mesh.vertices[seen])
    few = seen.any() and np.median(measured.views[seen]) <= MIN_VIEWS  # then all relief of a neck is noise
    hair = np.maximum(strands, neck) if few else strands
    mesh = smooth_unresolved(mesh, hair, clothes, neck, noise_mm=noise_mm, seen=seen_vertices, held=surface.capped)
    if surface.shell_deviation_mm is None:
        mesh, moved_mm = extend_to_outlines(mesh, strands, silhouettes, rig)
    topology = topology_of(mesh.faces, len(seen))
    smooth = smooth_spots(mesh.vertices, topology, surface.safe_world)  # no triangles cross
    clean = separate_coincidences(Mesh(smooth, mesh.faces))
    mended_mm = np.linalg.norm(clean.vertices - mesh.vertices, axis=1)
    mesh = clean
    part = np.where(seen, shown, Part.UNSEEN).astype(np.uint8)
    deviation = np.hypot(np.hypot(deviation_mm(seen_vertices, measured), STRAND_SHARE * moved_mm), mended_mm)
    if surface.shell_deviation_mm is not None:
        guessed = ~seen & facing_a_camera(mesh, rig)
        deviation[guessed] = np.minimum(deviation[guessed], surface.shell_deviation_mm)
    deviation[surface.capped] = MAX_MM
    moved = (mesh.vertices != smooth).any(axis=1)
    faults = mesh_faults(mesh.vertices.astype(np.float32).astype(float), topology, moved)
    return BustSurface(mesh, deviation, part, measured.views, surface.warnings, faults)


def facing_a_camera(mesh_world: Mesh, rig: Rig) -> Bool[np.ndarray, " v"]:
    """Returns a mask of vertices that face any camera, even if they are occluded."""
    normals, facing = mesh_world.normals(), np.zeros(len(mesh_world.vertices), bool)
    for camera in rig:
        facing |= ((camera.centre_world - mesh_world.vertices) * normals).sum(axis=1) > 0.0
    return facing


def mask_warnings(names: Sequence[str], contradicted: Float[np.ndarray, " k"]) -> Iterator[ReportWarning]:
    """Yields a warning for each view whose mask misses much more of the subject than the other views' masks.
    ``contradicted`` are the fractions of the crops that the masks miss according to other views."""
    usual = CONTRADICTED_TIMES * float(np.median(contradicted)) if len(contradicted) else 0.0
    limit = max(CONTRADICTED_WARNED, min(usual, CONTRADICTED_SOFT))
    for name, share in zip(names, contradicted, strict=True):
        if share > limit:
            yield compose("mask-contradicted", camera=name, share=share)


@traced
def closed_net(level: Level, head_world: Mesh | None) -> tuple[Mesh, Float[np.ndarray, "v 3"]]:
    """Returns the mesh of the zero level, restricted to the subject, and safe vertex positions (mm, world frame). The
    safe positions are the middles of the grid cells, with which the mesh cannot intersect itself."""
    grid, field = level.grid, level.field.copy()
    compose_well(field, grid.neighbours, grid.outer, TURNED_TO * grid.step_mm)
    net = surface_net(field, grid.index, grid.neighbours)
    vertices, faces, cells = net.vertices, net.faces, np.flatnonzero(net.of_cell >= 0)
    head = None if head_world is None else (head_world.vertices - grid.corner) / grid.step_mm
    kept = _subject(vertices, faces, head)
    taken = np.zeros(len(vertices), bool)
    taken[faces[kept]] = True
    used, row = np.flatnonzero(taken), np.cumsum(taken, dtype=np.int32) - 1
    placed = grid.corner + grid.step_mm * vertices[used]
    safe = grid.corner + grid.step_mm * (grid.index[cells[used]] + 0.5)
    return Mesh(placed, row[faces[kept]]), safe


def _subject(
    vertices: Float[np.ndarray, "v 3"], faces: np.ndarray, head: Float[np.ndarray, "h 3"] | None
) -> Bool[np.ndarray, " f"]:
    """Returns a mask of the faces that belong to the subject. With a fitted head, the subject is the piece nearest to
    most of the head's vertices, since a bystander may be larger. Without a head, the subject is the piece of greatest
    volume."""
    piece = component_of(faces, len(vertices))
    towards = vertices[faces[:, 0]] - vertices.mean(axis=0)
    volume = np.bincount(piece[faces[:, 0]], (face_normals(vertices, faces) * towards).sum(axis=1))
    if head is None or (volume > 0).sum() < 2:
        return piece[faces[:, 0]] == np.argmax(volume)
    solid = np.flatnonzero(volume[piece] > 0)
    near = nearest(PointTree.of(vertices[solid]), head[::HEAD_STRIDE])[1]
    return piece[faces[:, 0]] == np.bincount(piece[solid[near]]).argmax()
