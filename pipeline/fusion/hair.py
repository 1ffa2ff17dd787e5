"""Decides what counts as hair, and makes its surface as smooth as pictures resolve it.

Two cameras see other strands, so that windows match chance patterns: what depth says of them scatters
over millimetres and leaves gravel with pockets and handles. That is noise, not relief. Its votes are therefore weak in
the signed distance (``loosened``), which leaves no pockets, and its vertices take the mean of those about them.

Strands are thinner than a pixel and let through what lies behind them, so that windows match the dense core of the
hair, millimetres deeper than the strands that a photograph shows. Outlines show how much is missing: where the surface
turns away from a camera, its outline lies as far inside the silhouette. Between these rims the missing thickness is
interpolated. Hair that has a surface, as a helmet has, has depth nearly everywhere, and stays as it is.

Long hair of strands, whose depth photographs hardly show, is a smooth shell inside the visual hull. Places that match
here and there tell together how deep inside the hull the hair lies, and that distance is smooth. The fitted head, with
a thickness above it, says nothing of hair that hangs free.
"""

from collections.abc import Mapping, Sequence
from dataclasses import replace
from functools import lru_cache

import cv2
import numpy as np
from jaxtyping import Bool, Float, Float32, Int

from pipeline.compute.threads import map_in_threads
from pipeline.compute.trace import traced
from pipeline.fusion.grid import Grid
from pipeline.fusion.prior import near_rim
from pipeline.fusion.refinement import EDGE_MM, SeenVertices, neighbours
from pipeline.fusion.refinement_kernels import blurred_over_mesh
from pipeline.fusion.skin import mean_around, skin_share
from pipeline.fusion.view_stack import ViewStack
from pipeline.fusion.vote_kernels import CENTRE
from pipeline.geometry.nearest import PointTree, nearest
from pipeline.geometry.raster import depth_map
from pipeline.imaging.silhouette import Silhouette
from pipeline.part_labels.codes import Part
from pipeline.part_labels.labelling import PartMap
from pipeline.part_labels.votes import PartVotes, part_shares, parts_shown
from pipeline.stereo.depth_map import DepthMap, placing, points_world
from rig.camera import Camera
from rig.mesh import Mesh, face_normals
from rig.rig import Rig

Places = Float[np.ndarray, "n 3"]

# Height (mm) over the head up to which hair is skin with hair's colour (stubble, brows, a beard), and from which on it
# is hair: the cells of beard-smile's beard lie 0.6 mm over the head in the median, those of its hair 3.5.
STUBBLE_MM = (1.0, 3.0)
CELLS = 64  # about a cell, whose mean height counts: 12 mm about it
RESOLVED_MM = 4.0  # standard deviation of the mean that a vertex of hair takes: gravel is 2 to 5 mm wide
STEP_SHARE = 0.46  # variance of one step of a mean, by the area of a vertex
OFF_HEAD_MM = 8.0  # from the head there is no skin: strands that hang before it have skin's colours in shade
SURELY = 0.5  # probability from which on a vertex of a rim counts as hair
EVERY = 4  # pixel of a rim is measured
RIM_PX = 0.5  # by which the pixels of a rim lie inside the outline
FRAME_PX = 3  # from the border of a photograph, where the outline is the photograph's
FARTHEST_MM = 30.0  # beyond that the outline is something else's
# Of the rim's places about one, this quantile counts: single hairs stand out, and outlines follow them. With the
# median, 64 % of a beard's strands lie within 2 mm, with this 73 %, with 0.2 77 %; of all hair 59, 59 and 58 %.
ABOUT, QUANTILE = 24, 0.35
NEAREST, EVEN_MM = 8, 8.0  # of them count at a vertex, and the distance within which they count alike
MIN_PLACES = 2 * ABOUT  # for a measurement
DENSE = 8  # power of hair's probability: where scalp shows between strands, the surface stays between the two
ROUNDS, SHARE = 2, 0.7  # the rim of what has been moved is another one: what is still missing is measured again
STRAND_SHARE = 0.5  # standard deviation of a moved vertex, by its way: strands lie between core and outline
# Share of the pixels of hair with a known depth, below which hair is silent: 0.25 of long strands, 0.53 of short ones
# and a beard, 0.82 and 0.84 of solid hair.
SILENT_SHARE = 0.4
LOOSER = 6.0  # by what the deviation of strands' depth is multiplied: the membrane bridges their pockets
SCATTERED_SHARE = (0.7, 0.8)  # the same, up to which what is known scatters wholly, and from which on not at all
MIN_HAIR = 0.2  # of what is not clothes; with less, hair is not worth it
LIKELY = 0.5  # probability from which on a place counts as a part
# Share of the pixels about one whose depth must be known, for skin and for clothes to count. Specks amid hair are
# chance; the face, which shows between the strands, and the shirt below them are known more evenly.
DENSE_SKIN, DENSE_CLOTHES, WINDOW_MM = 0.5, 0.4, 15.0
PLAIN_SHARE = 0.25  # the same of clothes, below which their depth is chance: 0.1 of a plain shirt, others 0.34 and more
PIXEL_EVERY = 4  # pixel of a crop, in either direction, is looked at
SHELL_VIEWS, MAX_PLACES = 3, 25_000  # views that agree on a depth, for it to tell how deep the hair lies
DEEPEST_MM = 30.0  # inside the hull; farther in a place belongs to something else
SHELL_AROUND = 36  # places, whose median is the depth of the hair about them
FACING = (-0.1, 0.2)  # cosine to a camera from which on the shell's outside counts as shown, and wholly
BESIDE_MM = (8.0, 16.0)  # from the hair, up to which there is a shell, and from which on none: a chest has none
SHELL_STEPS, DEPTH_STEPS = 1.0, 2.5  # of the grid: standard deviations of the blur of the shell, and of its depth
FAR_MM = 1000.0  # a length along the crop's rays, any


@traced
def find_silent_hair(
    depth_maps: Sequence[DepthMap], parts: Mapping[str, PartMap], votes: PartVotes | None, rig: Rig
) -> tuple[Places | None, Sequence[DepthMap], float]:
    """Tells whether the subject has long hair of which the photographs hardly show the depth.

    Args:
        depth_maps: of the views.
        parts: the part maps by camera, in pixels of the photographs.
        votes: which part each point of the depth maps shows (``parts_over_head``); without it there is no such hair.
        rig: the cameras as calibrated, world frame.

    Returns:
        Places (world, mm) of the hair on which some views agree, which only taken together tell how deep inside the
        hull it lies, and the depth maps without it; or None and the depth maps, whose hair counts less if it scatters.
        Third, how far (0 to 1) the depth of hair is noise.
    """
    known = known_share(depth_maps, parts, rig)
    scatter = float(np.interp(known, SCATTERED_SHARE, (1.0, 0.0)))
    if votes is None or known >= SILENT_SHARE:
        return (
            None,
            [loosened(each, parts, rig, scatter) for each in depth_maps] if scatter > 0.0 else depth_maps,
            scatter,
        )

    def split(depth_map: DepthMap) -> tuple[Float[np.ndarray, "n 3"], DepthMap]:
        points, known = points_world(depth_map), depth_map.known
        share = part_shares(votes, points) >= LIKELY
        clothes = share[:, Part.CLOTHES.channel]
        about = local_share(depth_map, parts, rig)[known]
        silent = share[:, Part.HAIR.channel] | (about < np.where(clothes, DENSE_CLOTHES, DENSE_SKIN))
        agreed = share[:, Part.HAIR.channel] & ~clothes & (depth_map.views[known] >= SHELL_VIEWS)
        kept = known.copy()
        kept[known] = ~silent
        return points[agreed], only_where(kept, depth_map)

    found = map_in_threads(lambda k: split(depth_maps[k]), len(depth_maps))
    places = np.concatenate([points for points, _ in found])
    if len(places) < SHELL_AROUND:
        return None, depth_maps, scatter
    return places[:: -(-len(places) // MAX_PLACES)], [each for _, each in found], 0.0


def only_where(kept: Bool[np.ndarray, "h w"], depth_map: DepthMap) -> DepthMap:
    """Returns the depth map with nothing known elsewhere."""
    return DepthMap(
        depth_map.camera,
        np.where(kept, depth_map.depth_mm, np.float32(0.0)),
        np.where(kept[..., None], depth_map.normal, np.float32(0.0)),
        np.where(kept, depth_map.deviation_mm, np.float32(np.inf)),
        np.where(kept, depth_map.views, np.uint8(0)),
    )


def without_specks(depth_map: DepthMap, parts: Mapping[str, PartMap], rig: Rig) -> DepthMap:
    """Returns the depth map; before plain clothes, of which hardly anything is known, without what is known here and
    there of them and of skin: it is chance, and lies centimetres before the subject."""
    _, hair, clothes = np.moveaxis(shown_parts(depth_map, parts, rig) > LIKELY, 2, 0)
    known, (height, width) = depth_map.known[::PIXEL_EVERY, ::PIXEL_EVERY], depth_map.depth_mm.shape
    if not clothes.any() or known[clothes].mean() > PLAIN_SHARE:
        return depth_map
    strands = np.asarray(cv2.resize(hair.view(np.uint8), (width, height))) > 0
    return only_where(strands | (local_share(depth_map, parts, rig) >= DENSE_CLOTHES), depth_map)


def shown_parts(depth_map: DepthMap, parts: Mapping[str, PartMap], rig: Rig) -> Float[np.ndarray, "r c 3"]:
    """Returns the probabilities of skin, hair and clothes at every ``PIXEL_EVERY``-th pixel of a crop, in either
    direction; 0 where there is no part map."""
    (fx, fy, cx, cy), turn, shift = placing(depth_map.camera)
    height, width = depth_map.depth_mm.shape
    row, column = np.mgrid[:height:PIXEL_EVERY, :width:PIXEL_EVERY]
    if depth_map.camera.name not in parts:
        return np.zeros((*row.shape, 3))
    rays = np.stack([(column - cx) / fx, (row - cy) / fy, np.ones(row.shape)], axis=-1).reshape(-1, 3)
    shown = parts_shown(FAR_MM * rays @ turn.T + shift, parts[depth_map.camera.name], rig[depth_map.camera.name])
    return shown.reshape(*row.shape, 3)


def known_share(depth_maps: Sequence[DepthMap], parts: Mapping[str, PartMap], rig: Rig) -> float:
    """Returns the share of the pixels of hair whose depth is known; 1 where there is hardly any hair."""

    def count(depth_map: DepthMap) -> Float[np.ndarray, " 3"]:
        skin, hair, _ = np.moveaxis(shown_parts(depth_map, parts, rig) > LIKELY, 2, 0)
        known = depth_map.known[::PIXEL_EVERY, ::PIXEL_EVERY]
        return np.array([(hair & known).sum(), hair.sum(), (hair | skin).sum()], float)

    counts = map_in_threads(lambda k: count(depth_maps[k]), len(depth_maps))
    known, hair, body = np.sum([np.zeros(3), *counts], axis=0)
    return 1.0 if hair <= MIN_HAIR * body else float(known / hair)


def loosened(depth_map: DepthMap, parts: Mapping[str, PartMap], rig: Rig, scatter: float) -> DepthMap:
    """Returns the depth map with larger deviations of hair, as far as its depth is noise (``scatter``)."""
    height, width = depth_map.depth_mm.shape
    hair = np.asarray(cv2.resize(shown_parts(depth_map, parts, rig)[..., Part.HAIR.channel], (width, height)))
    looser = 1.0 + (LOOSER - 1.0) * scatter * hair
    return replace(depth_map, deviation_mm=(depth_map.deviation_mm * looser).astype(np.float32))


def local_share(depth_map: DepthMap, parts: Mapping[str, PartMap], rig: Rig) -> Float32[np.ndarray, "h w"]:
    """Returns, for each pixel of a crop, the share of the subject's pixels about it whose depth is known."""
    body = (shown_parts(depth_map, parts, rig).sum(axis=2) > LIKELY).astype(np.float32)
    known = depth_map.known[::PIXEL_EVERY, ::PIXEL_EVERY] * body
    distance_mm = float(np.median(depth_map.depth_mm[depth_map.known])) if depth_map.known.any() else FAR_MM
    side = max(3, round(WINDOW_MM * depth_map.camera.intrinsics.fx / (PIXEL_EVERY * distance_mm)))
    share = cv2.blur(known, (side, side)) / np.maximum(cv2.blur(body, (side, side)), np.float32(1e-3))
    height, width = depth_map.depth_mm.shape
    return np.asarray(cv2.resize(share, (width, height), interpolation=cv2.INTER_LINEAR))


@traced
def distance_to_shell(
    hair: Places, views: ViewStack, box: Grid
) -> tuple[Float[np.ndarray, " _"], Float[np.ndarray, " _"]]:
    """Returns, at the nodes of a whole box, the signed distance (mm, positive outside) to the shell, and how far a
    photograph shows its outside there, 0 to 1: no silhouette bounds a surface that all cameras see from behind."""
    from scipy.ndimage import gaussian_filter  # only such hair needs it

    places = box.places()
    hull, (known, deep) = distance_to_hull(places, views), depth_inside(hair, views)
    band = np.flatnonzero(np.abs(hull) < DEEPEST_MM + 2.0 * box.step_mm)
    inset = np.full(len(hull), np.median(deep))
    off_mm, about = nearest(known, places[band], count=min(SHELL_AROUND, len(deep)))
    inset[band] = np.median(deep[about], axis=1)
    even = gaussian_filter(inset.reshape(box.shape), DEPTH_STEPS)
    field = np.clip(hull.reshape(box.shape) + even, -2.0 * DEEPEST_MM, 2.0 * DEEPEST_MM)
    normal = np.array(np.gradient(gaussian_filter(field, DEPTH_STEPS))).reshape(3, -1).T
    normal /= np.maximum(np.linalg.norm(normal, axis=1, keepdims=True), 1e-9)
    facing = np.full(len(hull), -1.0)
    for centre in views.cameras[:, CENTRE:]:
        towards = centre - places
        facing = np.maximum(facing, (normal * towards).sum(axis=1) / np.linalg.norm(towards, axis=1))
    shown = np.clip((facing - FACING[0]) / (FACING[1] - FACING[0]), 0.0, 1.0)
    shown[band] *= np.interp(off_mm[:, 0], BESIDE_MM, (1.0, 0.0))
    return gaussian_filter(field, SHELL_STEPS).ravel(), shown


def depth_inside(hair: Places, views: ViewStack) -> tuple[PointTree, Float[np.ndarray, " _"]]:
    """Returns the places of the hair, and how deep (mm) inside the hull each lies."""
    deep = -distance_to_hull(hair, views)
    within = (deep > 0.0) & (deep < DEEPEST_MM)
    return PointTree.of(hair[within]), deep[within]


def shell_deviation_mm(hair: Places, views: ViewStack) -> float:
    """Returns the standard deviation (mm) of the shell: that of the depth inside the hull over all of the hair. Places
    next to each other err alike (2 mm about their median, where true strands are 7 mm off)."""
    return float(depth_inside(hair, views)[1].std())


def distance_to_hull(places: Float[np.ndarray, "n 3"], views: ViewStack) -> Float[np.ndarray, " n"]:
    """Returns how far (mm, negative inside) points lie outside the visual hull; -inf where no photograph reaches."""
    edges_mm, outlines_mm = views.outside(places)
    return np.where(edges_mm > 0.0, -np.inf, outlines_mm).max(axis=0)


def parts_over_head(votes: PartVotes, head_world: Mesh, stubble: bool = True) -> PartVotes:
    """Returns the votes with the cells' heights over a head considered: skin that lies off it counts as hair, and with
    ``stubble`` hair that lies on its skin as skin."""
    skin, hair = Part.SKIN.channel, Part.HAIR.channel
    both, out = votes.probability[:, skin] + votes.probability[:, hair], votes.probability.copy()
    far, near = nearest(PointTree.of(head_world.vertices), votes.places)
    height = ((votes.places - head_world.vertices[near]) * head_world.normals()[near]).sum(axis=1)
    alike = _cells_about(votes)
    weight = out[alike, hair] + 1e-9
    mean_mm = (weight * height[alike]).sum(axis=1) / weight.sum(axis=1)
    over = np.interp(mean_mm, STUBBLE_MM, (0.0, 1.0)) if stubble else 1.0
    off = (far > OFF_HEAD_MM) & ~near_rim(head_world, head_world.vertices)[near]  # below its end is a chest
    out[:, hair] = np.where(off, both, over * out[:, hair])
    out[:, skin] = both - out[:, hair]
    return replace(votes, probability=out)


@lru_cache(maxsize=1)  # a surface asks twice, before and after the head is refined
def _cells_about(votes: PartVotes) -> Int[np.ndarray, "g c"]:
    """Returns the rows of the cells nearest to each, itself among them."""
    return nearest(PointTree.of(votes.places), votes.places, count=min(CELLS, len(votes.places)))[1].astype(np.int32)


@traced
def smooth_hair(
    mesh_world: Mesh, hair: Float[np.ndarray, " v"], seen: SeenVertices, held: Bool[np.ndarray, " v"]
) -> Mesh:
    """Returns the mesh with the vertices of hair, and those far from all that is seen, moved to the mean of their
    surroundings.

    ``mesh_world``: closed, mm. ``hair``: probability that a vertex shows hair. ``seen``: by a view; the others are what
    is seen next to them. ``held``: vertices that stay.
    """
    beside = neighbours(mesh_world.faces, len(hair))
    share = skin_share(beside, 1.0 - hair, seen)
    share *= EDGE_MM / np.maximum(seen.guess_deviation_mm(), EDGE_MM)
    share = np.where(held, 1.0, share)[:, None]
    area_mm2 = 0.5 * np.linalg.norm(face_normals(mesh_world.vertices, mesh_world.faces), axis=1).sum() / len(hair)
    mean = blurred_over_mesh(mesh_world.vertices, *beside, round(RESOLVED_MM**2 / (STEP_SHARE * area_mm2)))
    return Mesh(share * mesh_world.vertices + (1.0 - share) * mean, mesh_world.faces)


@traced
def grown_to_outlines(
    mesh_world: Mesh, hair: Float[np.ndarray, " v"], silhouettes: Mapping[str, Silhouette], rig: Rig
) -> tuple[Mesh, Float[np.ndarray, " v"]]:
    """Moves the vertices of hair outwards to where the silhouettes show the hair to end.

    Args:
        mesh_world: the fused surface, closed, mm.
        hair: probability that a vertex shows hair of strands.
        silhouettes: by camera; those that are not usable are left out.
        rig: the cameras as calibrated, world frame.

    Returns:
        The moved mesh, and how far (mm) each vertex was moved.
    """
    sure = hair > SURELY
    rig = rig.subset(name for name in rig.names if name in silhouettes and silhouettes[name].quality.usable)
    if not sure.any() or not len(rig):
        return mesh_world, np.zeros(len(hair))
    mesh, beside = mesh_world, neighbours(mesh_world.faces, len(hair))
    for _ in range(ROUNDS):
        places, missing_mm = rims(mesh, sure, silhouettes, rig)
        if len(places) < MIN_PLACES:
            break
        outwards = np.zeros(len(hair))
        outwards[hair > 0.0] = missing_thickness(mesh.vertices[hair > 0.0], places, missing_mm)
        way = (SHARE * hair**DENSE * outwards)[:, None] * mesh.normals()
        smooth = [mean_around(beside, way[:, axis], np.ones(len(way))) for axis in range(3)]
        mesh = Mesh(mesh.vertices + np.stack(smooth, axis=1), mesh.faces)
    return mesh, np.linalg.norm(mesh.vertices - mesh_world.vertices, axis=1)


def rims(
    mesh_world: Mesh, counts: Bool[np.ndarray, " v"], silhouettes: Mapping[str, Silhouette], rig: Rig
) -> tuple[Float[np.ndarray, "n 3"], Float[np.ndarray, " n"]]:
    """Returns places (world, mm) where the surface turns away from a camera, and how far (mm) its outline there lies
    inside the camera's silhouette; only at vertices that ``counts``."""

    def seen_by(camera: Camera) -> tuple[Float[np.ndarray, "n 3"], Float[np.ndarray, " n"]]:
        depth, face = depth_map(camera, mesh_world.vertices, mesh_world.faces)
        solid = face >= 0
        inner = cv2.erode(solid.view(np.uint8), np.ones((3, 3), np.uint8)) > 0
        rim = solid & ~inner
        rim[:FRAME_PX], rim[-FRAME_PX:], rim[:, :FRAME_PX], rim[:, -FRAME_PX:] = False, False, False, False
        at = np.flatnonzero(rim)[::EVERY]
        vertex = mesh_world.faces[face.flat[at], 0]
        apart_px = -silhouettes[camera.name].distance.flat[at] - RIM_PX
        apart_mm = apart_px * depth.flat[at] / camera.intrinsics.fx
        used = counts[vertex] & (np.abs(apart_mm) < FARTHEST_MM)
        return mesh_world.vertices[vertex[used]], apart_mm[used].astype(float)

    found = map_in_threads(lambda k: seen_by(rig.cameras[k]), len(rig))
    return np.concatenate([places for places, _ in found]), np.concatenate([apart for _, apart in found])


def missing_thickness(
    vertices: Float[np.ndarray, "v 3"], places: Float[np.ndarray, "n 3"], missing_mm: Float[np.ndarray, " n"]
) -> Float[np.ndarray, " v"]:
    """Returns the thickness (mm) that is missing at each vertex: the mean of the nearest places', weighted by distance,
    each of which has the ``QUANTILE`` of those about it, and at least 0."""
    tree = PointTree.of(places)
    around = nearest(tree, places, count=ABOUT)[1]
    even_mm = np.maximum(np.quantile(missing_mm[around], QUANTILE, axis=1), 0.0)
    far, near = nearest(tree, vertices, count=NEAREST)
    weight = 1.0 / (far * far + EVEN_MM**2) ** 2
    return (weight * even_mm[near]).sum(axis=1) / weight.sum(axis=1)
