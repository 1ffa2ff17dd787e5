"""Guesses long hair of strands, whose outlines photographs show and whose depth they hardly do: a smooth shell inside
the visual hull.

Two cameras see other strands of such hair, so that windows match only here and there, and what they say scatters by
millimetres: a surface through it is a crust. Taken together these places tell how deep inside the hull the hair lies,
and that distance is smooth. The fitted head, with a thickness above it, says nothing of hair that hangs free.
"""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass

import cv2
import numpy as np
from jaxtyping import Bool, Float, Float32, UInt8

from pipeline.compute.threads import map_in_threads
from pipeline.compute.trace import traced
from pipeline.fusion.grid import Grid
from pipeline.fusion.view_stack import ViewStack
from pipeline.fusion.vote_kernels import CENTRE, FRAME, OUTLINE, PIXEL_STEP
from pipeline.geometry.nearest import PointTree, nearest
from pipeline.geometry.projection import project_points
from pipeline.geometry.projection_kernels import LENS
from pipeline.part_labels.codes import Part
from pipeline.part_labels.labelling import PartMap
from pipeline.part_labels.votes import PartVotes, part_shares
from pipeline.stereo.depth_map import DepthMap, placing, points_world
from rig.rig import Rig

# Share of the pixels of hair with a known depth, below which hair is silent: 0.25 of long strands, 0.53 of short ones
# and a beard, 0.82 and 0.84 of solid hair.
SILENT_SHARE = 0.4
SCATTERED_SHARE = (0.8, 0.7)  # the same, below which what is known scatters, and scatters wholly
MIN_HAIR = 0.2  # of what is not clothes; with less, hair is not worth it
LIKELY = 0.5  # probability from which on a place counts as a part
# Share of the pixels about one whose depth must be known, for skin and for clothes to count. Specks amid hair are
# chance; the face, which shows between the strands, and the shirt below them are known more evenly.
DENSE_SKIN, DENSE_CLOTHES, WINDOW_MM = 0.5, 0.4, 15.0
PIXEL_EVERY = 4  # pixel of a crop, in either direction, is looked at
MIN_VIEWS = 3  # that agree on a depth, for it to tell how deep the hair lies
MAX_PLACES = 25_000
DEEPEST_MM = 30.0  # inside the hull; farther in a place belongs to something else
AROUND = 36  # places, whose median is the depth of the hair about them
FACING = (-0.1, 0.2)  # cosine to a camera from which on the shell's outside counts as shown, and wholly
SHELL_STEPS, DEPTH_STEPS = 1.0, 2.5  # of the grid: standard deviations of the blur of the shell, and of its depth
FAR_MM = 1000.0  # a length along the crop's rays, any


@dataclass(frozen=True, slots=True, eq=False)
class SilentHair:
    """Holds what is known of hair whose depth is hardly known: ``places`` (world, mm) on which some views agree. They
    scatter, and only taken together tell how deep inside the hull the hair lies."""

    places: Float[np.ndarray, "n 3"]


@traced
def find_silent_hair(
    depth_maps: Sequence[DepthMap], parts: Mapping[str, PartMap], votes: PartVotes | None, rig: Rig, known: float
) -> tuple[SilentHair | None, Sequence[DepthMap]]:
    """Tells whether the subject has long hair of which the photographs hardly show the depth.

    Args:
        depth_maps: of the views.
        parts: the part maps by camera, in pixels of the photographs.
        votes: which part each point of the depth maps shows (``parts_over_head``); without it there is no such hair.
        rig: the cameras as calibrated, world frame.
        known: share of the hair's pixels with a known depth (``known_share``).

    Returns:
        The hair and the depth maps without what they say of it, or None and the same depth maps.
    """
    if votes is None or known >= SILENT_SHARE:
        return None, depth_maps

    def split(depth_map: DepthMap) -> tuple[Float[np.ndarray, "n 3"], DepthMap]:
        points, known = points_world(depth_map), depth_map.known
        share = part_shares(votes, points) >= LIKELY
        clothes = share[:, Part.CLOTHES.channel]
        about = local_share(depth_map, parts, rig)[known]
        silent = share[:, Part.HAIR.channel] | (about < np.where(clothes, DENSE_CLOTHES, DENSE_SKIN))
        agreed = silent & ~clothes & (depth_map.views[known] >= MIN_VIEWS)
        kept = known.copy()
        kept[known] = ~silent
        return points[agreed], only_where(kept, depth_map)

    found = map_in_threads(lambda k: split(depth_maps[k]), len(depth_maps))
    places = np.concatenate([points for points, _ in found])
    if len(places) < AROUND:
        return None, depth_maps
    return SilentHair(places[:: -(-len(places) // MAX_PLACES)]), [each for _, each in found]


def only_where(kept: Bool[np.ndarray, "h w"], depth_map: DepthMap) -> DepthMap:
    """Returns the depth map with nothing known elsewhere."""
    return DepthMap(
        depth_map.camera,
        np.where(kept, depth_map.depth_mm, np.float32(0.0)),
        np.where(kept[..., None], depth_map.normal, np.float32(0.0)),
        np.where(kept, depth_map.deviation_mm, np.float32(np.inf)),
        np.where(kept, depth_map.views, np.uint8(0)),
    )


def shown_parts(depth_map: DepthMap, parts: Mapping[str, PartMap], rig: Rig) -> UInt8[np.ndarray, "r c 3"]:
    """Returns the probabilities (255ths) of skin, hair and clothes at every ``PIXEL_EVERY``-th pixel of a crop, in
    either direction; 0 where there is no part map."""
    (fx, fy, cx, cy), turn, shift = placing(depth_map.camera)
    height, width = depth_map.depth_mm.shape
    row, column = np.mgrid[:height:PIXEL_EVERY, :width:PIXEL_EVERY]
    out = np.zeros((row.size, 3), np.uint8)
    if depth_map.camera.name in parts:
        shown = parts[depth_map.camera.name].of_255
        rays = np.stack([(column.ravel() - cx) / fx, (row.ravel() - cy) / fy, np.ones(row.size)], axis=1)
        pixels = np.rint(project_points(rig[depth_map.camera.name], FAR_MM * rays @ turn.T + shift))
        framed = ((pixels >= 0) & (pixels < shown.shape[1::-1])).all(axis=1)
        at = pixels[framed].astype(int)
        out[framed] = shown[at[:, 1], at[:, 0]]
    return out.reshape(*row.shape, 3)


def known_share(depth_maps: Sequence[DepthMap], parts: Mapping[str, PartMap], rig: Rig) -> float:
    """Returns the share of the pixels of hair whose depth is known; 1 where there is hardly any hair."""

    def count(depth_map: DepthMap) -> Float[np.ndarray, " 3"]:
        skin, hair, _ = np.moveaxis(shown_parts(depth_map, parts, rig) > 255 * LIKELY, 2, 0)
        known = depth_map.known[::PIXEL_EVERY, ::PIXEL_EVERY]
        return np.array([(hair & known).sum(), hair.sum(), (hair | skin).sum()], float)

    counts = map_in_threads(lambda k: count(depth_maps[k]), len(depth_maps))
    known, hair, body = np.sum([np.zeros(3), *counts], axis=0)
    return 1.0 if hair <= MIN_HAIR * body else float(known / hair)


def scatter_of(known: float) -> float:
    """Returns how far (0 to 1) the depth of hair is noise, from the share of its pixels with a known depth."""
    return float(np.clip((SCATTERED_SHARE[0] - known) / (SCATTERED_SHARE[0] - SCATTERED_SHARE[1]), 0.0, 1.0))


def local_share(depth_map: DepthMap, parts: Mapping[str, PartMap], rig: Rig) -> Float32[np.ndarray, "h w"]:
    """Returns, for each pixel of a crop, the share of the subject's pixels about it whose depth is known."""
    body = (shown_parts(depth_map, parts, rig).sum(axis=2) > 255 * LIKELY).astype(np.float32)
    known = depth_map.known[::PIXEL_EVERY, ::PIXEL_EVERY] * body
    distance_mm = float(np.median(depth_map.depth_mm[depth_map.known])) if depth_map.known.any() else FAR_MM
    side = max(3, round(WINDOW_MM * depth_map.camera.intrinsics.fx / (PIXEL_EVERY * distance_mm)))
    share = cv2.blur(known, (side, side)) / np.maximum(cv2.blur(body, (side, side)), np.float32(1e-3))
    height, width = depth_map.depth_mm.shape
    return np.asarray(cv2.resize(share, (width, height), interpolation=cv2.INTER_LINEAR))


@traced
def distance_to_shell(
    hair: SilentHair, views: ViewStack, box: Grid
) -> tuple[Float[np.ndarray, " n"], Float[np.ndarray, " n"]]:
    """Returns, at the nodes of a whole box, the signed distance (mm, positive outside) to the shell, and how far a
    photograph shows its outside there, 0 to 1: what all cameras see from behind, no silhouette bounds."""
    from scipy.ndimage import gaussian_filter  # only such hair needs it

    places = box.places()
    hull, (known, deep) = distance_to_hull(places, views), depth_inside(hair, views)
    band = np.flatnonzero(np.abs(hull) < DEEPEST_MM + 2.0 * box.step_mm)
    inset = np.full(len(hull), np.median(deep))
    inset[band] = np.median(deep[nearest(known, places[band], count=min(AROUND, len(deep)))[1]], axis=1)
    even = gaussian_filter(inset.reshape(box.shape), DEPTH_STEPS)
    field = np.clip(hull.reshape(box.shape) + even, -2.0 * DEEPEST_MM, 2.0 * DEEPEST_MM)
    normal = np.array(np.gradient(gaussian_filter(field, DEPTH_STEPS))).reshape(3, -1).T
    normal /= np.maximum(np.linalg.norm(normal, axis=1, keepdims=True), 1e-9)
    facing = np.full(len(hull), -1.0)
    for centre in views.cameras[:, CENTRE:]:
        towards = centre - places
        facing = np.maximum(facing, (normal * towards).sum(axis=1) / np.linalg.norm(towards, axis=1))
    shown = np.clip((facing - FACING[0]) / (FACING[1] - FACING[0]), 0.0, 1.0)
    return gaussian_filter(field, SHELL_STEPS).ravel(), shown


def depth_inside(hair: SilentHair, views: ViewStack) -> tuple[PointTree, Float[np.ndarray, " n"]]:
    """Returns the places of the hair, and how deep (mm) inside the hull each lies."""
    deep = -distance_to_hull(hair.places, views)
    within = (deep > 0.0) & (deep < DEEPEST_MM)
    return PointTree.of(hair.places[within]), deep[within]


def shell_deviation_mm(hair: SilentHair, views: ViewStack) -> float:
    """Returns the standard deviation (mm) of the shell: that of the depth inside the hull over all of the hair. Places
    next to each other err alike (2 mm about their median, where true strands are 7 mm off)."""
    return float(depth_inside(hair, views)[1].std())


def distance_to_hull(places: Float[np.ndarray, "n 3"], views: ViewStack) -> Float[np.ndarray, " n"]:
    """Returns how far (mm, negative inside) points lie outside the visual hull; -inf where no photograph reaches."""

    def outside(view: int) -> Float[np.ndarray, " n"]:
        camera, (height, width) = views.cameras[view], views.sizes[view]
        x, y, z = camera[:9].reshape(3, 3) @ places.T + camera[9:12, None]
        depth = np.maximum(z, 1.0)
        fx, fy, cx, cy = camera[LENS : LENS + 4]
        column, row = np.rint(fx * x / depth + cx), np.rint(fy * y / depth + cy)
        framed = (z > 1.0) & (column >= 0) & (column < width) & (row >= 0) & (row < height)
        at = views.starts[view] + np.where(framed, row * width + column, 0).astype(int)
        framed &= views.shown[at, FRAME] <= 0
        return np.where(framed, PIXEL_STEP * views.shown[at, OUTLINE] * depth / fx, -np.inf)

    return np.max(map_in_threads(outside, len(views.cameras)), axis=0)
