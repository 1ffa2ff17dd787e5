"""Smooths the surface of hair, and handles long hair whose depth cannot be measured.

In hair, dense matching finds chance patterns of strands. The depth of hair therefore scatters over millimetres, and the
fused surface would be rough, with pockets and handles. Therefore depth of hair gets a small weight in the signed
distance (``loosen_hair``), and hair vertices are smoothed. Matching also looks through strands to the dense core of the
hair or to the scalp, so hair at the silhouettes' rims is moved outwards until it is as far inside all silhouettes as
visible strands. Hair with a smooth surface has depth nearly everywhere, and is not changed.

Long hair with hardly any measured depth is modelled as a smooth shell inside the visual hull. The shell's distance from
the hull is estimated from the few measured points.
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
from pipeline.fusion.skin import STEP_SHARE, mean_around, skin_share
from pipeline.fusion.view_stack import ViewStack
from pipeline.fusion.vote_kernels import CENTRE, blurred_over_mesh
from pipeline.geometry.nearest import PointTree, nearest
from pipeline.geometry.projection import camera_depths, project_points
from pipeline.imaging.silhouette import Silhouette
from pipeline.part_labels.codes import Part
from pipeline.part_labels.labelling import PartMap
from pipeline.part_labels.votes import PartVotes, part_shares, parts_shown
from pipeline.stereo.depth_map import DepthMap, placing, points_world
from rig.mesh import Mesh, face_normals
from rig.rig import Rig

Places = Float[np.ndarray, "n 3"]

# Height (mm) over the head up to which hair is skin with hair's colour (stubble, brows, a beard), and from which on it
# is hair: the cells of beard-smile's beard lie 0.6 mm over the head in the median, those of its hair 3.5.
STUBBLE_MM = (1.0, 3.0)
CELLS = 64  # about a cell, whose mean height counts: 12 mm about it
RESOLVED_MM = 4.0  # standard deviation of the mean that a vertex of hair takes: gravel is 2 to 5 mm wide
CLOTHES_DEVIATIONS = 2.0  # of depth, by which that mean may move clothes: shirts lose half of their gravel, a rim stays
OFF_HEAD_MM = 8.0  # from the head there is no skin: strands that hang before it have skin's colours in shade
NECK_MM = 45.0  # above the head's end necks are off their model's place, and below it is a chest
FRAME_PX = 3  # from the border of a photograph, where the outline is the photograph's
STRANDS = 0.2, 0.6  # probability of hair from which on it is moved to its outlines, and wholly
TANGENT = 0.25, 0.5  # cosine to a camera up to which its outline bounds the surface, and from which on not: there a
# ball's of 80 mm lies 2.6 mm inside it, here 12
INSET_MM, MAX_WAY_MM = 2.5, 12.0  # of true strands inside beard-smile's hull (median 2.7), and the farthest move
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
    """Finds long hair that has hardly any measured depth.

    Args:
        depth_maps: of the views.
        parts: the part maps by camera, in pixels of the photographs.
        votes: part labels of the depth maps' points (``correct_parts``); None means that no long hair is searched.
        rig: the cameras as calibrated, world frame.

    Returns: The measured points (world frame, mm) of long hair, or None; the depth maps without this hair, or with less
        weight for hair that scatters; and the noise fraction (0 to 1) of the depth of hair.
    """
    known = known_share(depth_maps, parts, rig)
    scatter = float(np.interp(known, SCATTERED_SHARE, (1.0, 0.0)))
    if votes is None or known >= SILENT_SHARE:
        loose = [loosen_hair(each, parts, rig, scatter) for each in depth_maps] if scatter > 0.0 else depth_maps
        return None, loose, scatter

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
    """Returns the depth map with all pixels outside ``kept`` set to unknown."""
    return DepthMap(
        depth_map.camera,
        np.where(kept, depth_map.depth_mm, np.float32(0.0)),
        np.where(kept[..., None], depth_map.normal, np.float32(0.0)),
        np.where(kept, depth_map.deviation_mm, np.float32(np.inf)),
        np.where(kept, depth_map.views, np.uint8(0)),
    )


def remove_specks(depth_map: DepthMap, parts: Mapping[str, PartMap], rig: Rig) -> DepthMap:
    """Removes isolated depths of skin and clothes from a depth map in which plain clothes have hardly any depth.
    Isolated depths are chance matches and lie centimetres in front of the subject."""
    _, hair, clothes = np.moveaxis(shown_parts(depth_map, parts, rig) > LIKELY, 2, 0)
    known, (height, width) = depth_map.known[::PIXEL_EVERY, ::PIXEL_EVERY], depth_map.depth_mm.shape
    if not clothes.any() or known[clothes].mean() > PLAIN_SHARE:
        return depth_map
    strands = np.asarray(cv2.resize(hair.view(np.uint8), (width, height))) > 0
    return only_where(strands | (local_share(depth_map, parts, rig) >= DENSE_CLOTHES), depth_map)


def shown_parts(depth_map: DepthMap, parts: Mapping[str, PartMap], rig: Rig) -> Float[np.ndarray, "r c 3"]:
    """Returns the probabilities of skin, hair and clothes at every ``PIXEL_EVERY``-th row and column of a crop; 0 where
    there is no part map."""
    (fx, fy, cx, cy), turn, shift = placing(depth_map.camera)
    height, width = depth_map.depth_mm.shape
    row, column = np.mgrid[:height:PIXEL_EVERY, :width:PIXEL_EVERY]
    if depth_map.camera.name not in parts:
        return np.zeros((*row.shape, 3))
    rays = np.stack([(column - cx) / fx, (row - cy) / fy, np.ones(row.shape)], axis=-1).reshape(-1, 3)
    shown = parts_shown(FAR_MM * rays @ turn.T + shift, parts[depth_map.camera.name], rig[depth_map.camera.name])
    return shown.reshape(*row.shape, 3)


def known_share(depth_maps: Sequence[DepthMap], parts: Mapping[str, PartMap], rig: Rig) -> float:
    """Returns the fraction of hair pixels with known depth; 1 if there is hardly any hair."""

    def count(depth_map: DepthMap) -> Float[np.ndarray, " 3"]:
        skin, hair, _ = np.moveaxis(shown_parts(depth_map, parts, rig) > LIKELY, 2, 0)
        known = depth_map.known[::PIXEL_EVERY, ::PIXEL_EVERY]
        return np.array([(hair & known).sum(), hair.sum(), (hair | skin).sum()], float)

    counts = map_in_threads(lambda k: count(depth_maps[k]), len(depth_maps))
    known, hair, body = np.sum([np.zeros(3), *counts], axis=0)
    return 1.0 if hair <= MIN_HAIR * body else float(known / hair)


def loosen_hair(depth_map: DepthMap, parts: Mapping[str, PartMap], rig: Rig, scatter: float) -> DepthMap:
    """Returns the depth map with enlarged standard deviations of hair, according to its noise fraction ``scatter``."""
    height, width = depth_map.depth_mm.shape
    hair = np.asarray(cv2.resize(shown_parts(depth_map, parts, rig)[..., Part.HAIR.channel], (width, height)))
    looser = 1.0 + (LOOSER - 1.0) * scatter * hair
    return replace(depth_map, deviation_mm=(depth_map.deviation_mm * looser).astype(np.float32))


def local_share(depth_map: DepthMap, parts: Mapping[str, PartMap], rig: Rig) -> Float32[np.ndarray, "h w"]:
    """Returns, for each pixel of a crop, the fraction of the subject's pixels around it with known depth."""
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
    """Returns, at the nodes of a dense box, the signed distance (mm, positive outside) to the shell of hair, and a
    weight (0 to 1). The weight is 0 where no camera sees the shell's outside."""
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
    """Returns the measured points of the hair, and the depth (mm) of each inside the visual hull."""
    deep = -distance_to_hull(hair, views)
    within = (deep > 0.0) & (deep < DEEPEST_MM)
    return PointTree.of(hair[within]), deep[within]


def shell_deviation_mm(hair: Places, views: ViewStack) -> float:
    """Returns the standard deviation (mm) of the shell: the spread of the depth inside the hull over all of the hair,
    because neighbouring points have common errors."""
    return float(depth_inside(hair, views)[1].std())


def distance_to_hull(places: Float[np.ndarray, "n 3"], views: ViewStack) -> Float[np.ndarray, " n"]:
    """Returns the signed distance (mm, negative inside) of points to the visual hull; -inf outside all photographs."""
    edges_mm, outlines_mm = views.outside(places)
    return np.where(edges_mm > 0.0, -np.inf, outlines_mm).max(axis=0)


def correct_parts(votes: PartVotes, head_world: Mesh, stubble: bool = True) -> PartVotes:
    """Corrects part labels by their cells' heights over the head: skin far above the head becomes hair. With
    ``stubble``, hair close to the head becomes skin."""
    skin, hair = Part.SKIN.channel, Part.HAIR.channel
    both, out = votes.probability[:, skin] + votes.probability[:, hair], votes.probability.copy()
    far, near = nearest(PointTree.of(head_world.vertices), votes.places)
    height = ((votes.places - head_world.vertices[near]) * head_world.normals()[near]).sum(axis=1)
    alike = _cells_about(votes)
    weight = out[alike, hair] + 1e-9
    mean_mm = (weight * height[alike]).sum(axis=1) / weight.sum(axis=1)
    over = np.interp(mean_mm, STUBBLE_MM, (0.0, 1.0)) if stubble else 1.0
    off = (far > OFF_HEAD_MM) & ~near_rim(head_world, head_world.vertices, NECK_MM)[near]
    out[:, hair] = np.where(off, both, over * out[:, hair])
    out[:, skin] = both - out[:, hair]
    return replace(votes, probability=out)


@lru_cache(maxsize=1)  # a surface asks twice, before and after the head is refined
def _cells_about(votes: PartVotes) -> Int[np.ndarray, "g c"]:
    """Returns the indices of the cells nearest to each cell, itself included."""
    return nearest(PointTree.of(votes.places), votes.places, count=min(CELLS, len(votes.places)))[1].astype(np.int32)


@traced
def smooth_unresolved(
    mesh_world: Mesh,
    hair: Float[np.ndarray, " v"],
    clothes: Float[np.ndarray, " v"],
    neck: Float[np.ndarray, " v"],
    *,
    noise_mm: Float[np.ndarray, " v"],
    seen: SeenVertices,
    held: Bool[np.ndarray, " v"],
) -> Mesh:
    """Smooths the vertices of hair, clothes and neck, and vertices far from all seen ones, since their fine relief is
    noise. Clothes and necks have edges, so they move by little more than their noise.

    ``mesh_world``: closed, mm. ``hair``, ``clothes``, ``neck``: probability that a vertex shows them. ``noise_mm``:
    standard deviation of depth. ``seen``: vertices that a view sees; other vertices take the part of the nearest of
    these. ``held``: vertices of the flat end of the bust, which do not move except at its edge.
    """
    beside = neighbours(mesh_world.faces, len(hair))
    share = np.minimum(skin_share(beside, 1.0 - np.maximum(hair, clothes), seen), 1.0 - neck)
    share *= EDGE_MM / np.maximum(seen.guess_deviation_mm(), EDGE_MM)
    around = mean_around(beside, held.astype(float), np.ones(len(held)))
    edge = 4.0 * around * (1.0 - around)  # of the cap, which the grid cuts like a saw
    share = (np.where(held, 1.0, share) * (1.0 - edge))[:, None]
    area_mm2 = 0.5 * np.linalg.norm(face_normals(mesh_world.vertices, mesh_world.faces), axis=1).sum() / len(hair)
    mean = blurred_over_mesh(mesh_world.vertices, *beside, round(RESOLVED_MM**2 / (STEP_SHARE * area_mm2)))
    way = (1.0 - share) * (mean - mesh_world.vertices)
    most_mm = CLOTHES_DEVIATIONS * mean_around(beside, noise_mm, seen.themselves.astype(float))
    bounded = seen.themselves & (np.maximum(clothes, neck) > hair) & (edge < LIKELY)
    way[bounded] *= np.minimum(1.0, most_mm / np.maximum(np.linalg.norm(way, axis=1), 1e-9))[bounded, None]
    return Mesh(mesh_world.vertices + way, mesh_world.faces)


@traced
def extend_to_outlines(
    mesh_world: Mesh, hair: Float[np.ndarray, " v"], silhouettes: Mapping[str, Silhouette], rig: Rig
) -> tuple[Mesh, Float[np.ndarray, " v"]]:
    """Moves the vertices of hair outwards to the hair's end in the silhouettes.

    Args:
        mesh_world: the fused surface, closed, mm.
        hair: probability that a vertex shows loose hair.
        silhouettes: by camera; unusable ones are left out.
        rig: the cameras as calibrated, world frame.

    Returns:
        The moved mesh, and the distance (mm) that each vertex was moved.
    """
    rig = rig.subset(name for name in rig.names if name in silhouettes and silhouettes[name].quality.usable)
    rows, moved_mm = np.flatnonzero(hair > 0.0), np.zeros(len(hair))
    if not len(rows) or not len(rig):
        return mesh_world, moved_mm
    beside, vertices, normals = neighbours(mesh_world.faces, len(hair)), mesh_world.vertices[rows], mesh_world.normals()
    inside_mm, facing, tangent = depth_inside_outlines(vertices, normals[rows], silhouettes, rig)
    share = np.interp(hair[rows], STRANDS, (0.0, 1.0)) * np.interp(facing, FACING, (0.0, 1.0))
    share *= np.interp(tangent, TANGENT, (1.0, 0.0))
    moved_mm[rows] = share * np.clip(inside_mm - INSET_MM, 0.0, MAX_WAY_MM)
    way = np.stack([mean_around(beside, moved_mm * each, np.ones(len(hair))) for each in normals.T], axis=1)
    return Mesh(mesh_world.vertices + way, mesh_world.faces), np.linalg.norm(way, axis=1)


def depth_inside_outlines(
    places: Places, normals: Places, silhouettes: Mapping[str, Silhouette], rig: Rig
) -> tuple[Float[np.ndarray, " n"], Float[np.ndarray, " n"], Float[np.ndarray, " n"]]:
    """Returns the depth (mm, at least 0) of points inside all silhouettes; 0 if no silhouette bounds them; also returns
    the largest cosine between their normals and the directions to cameras, and the smallest absolute cosine."""
    inside_mm, cosines = np.full(len(places), np.inf), np.zeros((len(rig), len(places)))
    for k, camera in enumerate(rig):
        distance, towards = silhouettes[camera.name].distance, camera.centre_world - places
        height, width = distance.shape
        column, row = np.rint(np.nan_to_num(project_points(camera, places), nan=-1.0)).astype(int).T
        shown = (column >= FRAME_PX) & (column < width - FRAME_PX) & (row >= FRAME_PX) & (row < height - FRAME_PX)
        off_mm = -distance[row[shown], column[shown]] * camera_depths(camera, places[shown]) / camera.intrinsics.fx
        inside_mm[shown] = np.minimum(inside_mm[shown], off_mm)
        cosines[k] = (normals * towards).sum(axis=1) / np.linalg.norm(towards, axis=1)
    return np.where(np.isinf(inside_mm), 0.0, inside_mm), cosines.max(axis=0), np.abs(cosines).min(axis=0)
