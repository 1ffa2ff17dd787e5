"""Computes depth, normal and standard deviation for every view by matching the photographs.

Every view is matched with its neighbours, from coarse to fine, by windows on slanted planes that propagate between
pixels (Bleyer, Rhemann and Rother, *PatchMatch stereo*, 2011, https://doi.org/10.5244/C.25.14). In contrast to
PatchMatch, no random numbers are used. Silhouettes and the fitted head bound the search (``depth_range``). Semi-global
matching of depths at even steps gives the first estimate (``find_fields``). Least squares then moves the windows by
fractions of a pixel and computes their information (Goesele et al., *Multi-view stereo for community photo
collections*, 2007, https://doi.org/10.1109/ICCV.2007.4408933). Depths that no other view confirms are discarded.

The first depths are searched twice. In the first search windows have the slant of the range's bounds. At the border of
a photograph no silhouette bounds the visual hull, whose side is then much steeper than the real surface, and windows
with its slant do not match. Therefore in the second search the windows in wide ranges have the slant of the depths
around them.

From one image size to the next, planes are upsampled, pixels take over better planes of their neighbours, and each
plane moves to the best match. A part of the information from the smaller size is kept, because its larger windows
contain more shading. The kept information is smaller where the surface has relief, which large windows miss.

Each view is refined by itself, and all views are compared at the end, so the result does not depend on the order of
threads.
"""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass

import cv2
import numpy as np
from jaxtyping import Bool, Float, Float32, Int, Int32, UInt8

from pipeline.compute.threads import map_in_threads
from pipeline.compute.trace import traced
from pipeline.imaging.silhouette import Silhouette
from pipeline.multiview.visual_hull import hull_extent
from pipeline.stereo.crops import MAX_UNSEEN_PX, Crop, make_crops
from pipeline.stereo.depth_map import DepthMap, Field, placing
from pipeline.stereo.depth_map_kernels import (
    count_agreeing,
    double,
    fill_specks,
    fit_planes,
    mark_specks,
    normals_of_known,
)
from pipeline.stereo.depth_range import REACH_MM, STEEPEST, DepthRange, find_depth_ranges
from pipeline.stereo.matcher import Matching, Planes, matching_on
from pipeline.stereo.matching_kernels import aggregate
from pipeline.stereo.stack import Stack, stack_crops
from rig.camera import Camera
from rig.mesh import Mesh
from rig.progress import Progress
from rig.render.compute import ComputeDevice
from rig.rig import Rig

MATCH_FACTOR = 1.6  # of a match's own standard deviation: samples of a window are not independent
MATCH_FLOOR_MM = 0.1  # error of a match that its window does not show
CARRIED = 0.5  # share of the information that goes on to the next size, as far as ...
RELIEF_FACTOR = 3.0  # ... this many times the relief about a pixel allows: without it hair and lids blur
GAP_PX = 1.0  # between the planes of two pixels of one piece
SWEEPS = 30  # a speck of 60 pixels is 8 wide
LABELS = 21  # depths along a ray in each of two sweeps: 4.5 mm apart at the deepest; 41 are no better
# On the subject, of images that are searched: windows of 5 pixels then span 10 mm. At 512 x 384 a quarter of the size,
# 4.2 mm a pixel, left 21 % of the face 2 mm off, half of it leaves 14 % (an oily head, noise of 6 levels).
SEARCH_PIXEL_MM = 2.1
FIRST_LEVELS = (1, 2)  # half and quarter of the photographs' size
WIDE_MM = 60.0  # of a range: nothing but the hull bounds it. The fitted head's slopes are better than found ones
AROUND_PX = 3.0  # sigma of the window over which slopes are found: 6 mm. With 4 and 6 less of all is right
EVEN_PX2 = 0.5  # variance of places that is added: a single line of pixels has no slope across
# Costs are 1 minus a correlation. A step of one label is a slope that the room's bounds do not have; a wider step is an
# edge, which three or four pixels of clear texture pay for.
STEP_COST, EDGE_COST = np.float32(0.1), np.float32(0.8)
Plane = Float32[np.ndarray, "h w"]

MAX_DEVIATION_MM = 2.0  # a depth with a larger standard deviation is discarded
OUTLINE_PX = 1.0  # no depth nearer to the background: the edge is blurred over it
AGREE_MM = 1.5  # two views agree where their surfaces are nearer than that ...
AGREE_DEVIATIONS = 3.0  # ... and than this many of their joint standard deviation
# Views that see past a place, for each that has it too: they may err as well. At 1 a tenth of the hair is lost, without
# a bound a percent of what is told lies more than 2 mm off.
MAX_CONTRADICTING_VIEWS = 2
# Variance along the ray of what the views agree on, by features that say it on two captures rendered by another program
# (330,000 pixels; Student's t with 3 degrees of freedom by most likelihood, then scaled until 68 % lie within one
# standard deviation). Given these a match's own information says nothing more.
RELIEF_SHARE = 2.8  # of the square of the relief about the pixel
APART_SHARE = 0.9  # of the mean square distance to the other views' surfaces, brought onto the ray
PIXEL_SHARE = 0.56  # of a pixel's square on the surface, brought onto the ray, by the square of the views that agree


def replace_specks(
    depth: Float32[np.ndarray, "h w"], slopes: Float32[np.ndarray, "h w 2"], pixel_mm: float, most_px: int
) -> Bool[np.ndarray, "h w"]:
    """Replaces, in place, small separate pieces of surface (at most ``most_px`` pixels) by a smooth surface through the
    pixels around them. Returns a mask of the replaced pixels.

    A small piece stays if no pixels around it have a known depth, as at an outline. A small piece also stays if it is
    adjacent to other pieces that together exceed ``most_px``. In one capture the replacement of all small pieces would
    have lost 6 % of the clothes.
    """
    specks = np.zeros(depth.shape, bool)
    mark_specks(depth, slopes, GAP_PX * pixel_mm, most_px, specks)
    _, labels, stats, _ = cv2.connectedComponentsWithStats(specks.astype(np.uint8), connectivity=4)
    group = np.asarray(labels, np.int32)
    inside = (depth > 0.0).astype(np.uint8)
    inner = cv2.erode(inside, np.ones((3, 3), np.uint8), borderType=cv2.BORDER_CONSTANT, borderValue=0)
    enclosed = stats[:, cv2.CC_STAT_AREA] <= most_px
    enclosed[np.unique(group[inner == 0])] = False
    specks &= enclosed[group]
    fill_specks(depth, slopes, specks, SWEEPS)
    return specks


RADIUS_PX = 2  # of the neighbourhood that a plane is laid through
MIN_INFORMATION = 1e-4  # 1 / mm^2: a standard deviation of 100 mm
SAME_PX = 0.1  # planes that differ by less are one: a slide takes either to its place
PLANE_ROUNDS = 2  # what takes a speck's place is tried against its neighbours, too
MAX_SLIDE_PX = 1.0  # of a step: linear models of an image reach no farther


def upsample_fields(fields: Sequence[Field], stack: Stack) -> list[Field]:
    """Upsamples the fields to twice their width and height, the size of ``stack``. The fields keep a part of their
    information."""

    def work(view: int) -> Field:
        field, distance = fields[view], stack.image(stack.distance_px, view)
        live = (distance < 0.5) & (distance > MAX_UNSEEN_PX)
        depth, slopes = np.empty(live.shape, np.float32), np.empty((*live.shape, 2), np.float32)
        double(field.depth, field.slopes, live, depth, slopes)
        relief = (RELIEF_FACTOR * field.relief_mm) ** 2
        known = CARRIED * field.information / (1.0 + field.information * relief)
        information = cv2.resize(known, None, fx=2, fy=2, interpolation=cv2.INTER_NEAREST)
        zero = np.zeros_like(depth)
        return Field(depth, slopes, information, zero, zero)

    return map_in_threads(work, len(fields))


@dataclass(frozen=True, slots=True)
class Pass:
    """Holds the parameters of the plane refinement at one image size."""

    steps_px: tuple[int, ...]  # each pixel tries the planes of pixels that far away (odd)
    speck_px: int  # pieces of surface of so few pixels are replaced
    rounds: int  # of least squares


def refine_fields(fields: Sequence[Field], matching: Matching, once: Pass) -> list[Field]:
    """Refines the field of every view: pixels take over their neighbours' planes, small wrong pieces of surface are
    replaced, and least squares then moves the planes."""

    def work(view: int) -> Field:
        return _refined(fields[view], matching, view, once)

    return map_in_threads(work, len(fields))


def _refined(field: Field, matching: Matching, view: int, once: Pass) -> Field:
    matcher = matching.matcher(view)
    depth, slopes, live = field.depth.copy(), field.slopes.copy(), field.depth > 0.0
    pixel_mm = float(depth[live].mean() / matching.stack.lens[view, 0]) if live.any() else 1.0
    specks = np.zeros(depth.shape, bool)
    if once.steps_px:
        planes = Planes(depth, slopes, np.full(depth.shape, -1.0, np.float32), live.copy())
        black = np.indices(depth.shape).sum(axis=0) % 2 == 0
        for _ in range(PLANE_ROUNDS):
            for parity, tried in ((0, ~black), (1, black)):
                matcher.propagate(planes, parity, once.steps_px, SAME_PX * pixel_mm)
                planes.fresh[tried] = False
            specks = replace_specks(depth, slopes, pixel_mm, once.speck_px)
            planes.cost[specks], planes.fresh[specks] = -1.0, True
    before, known = depth, np.where(specks, np.float32(0.0), field.information) + MIN_INFORMATION
    information, relief, likeness = known, np.zeros_like(depth), np.zeros_like(depth)
    for _ in range(once.rounds):
        place, seen, likeness = matcher.slide(MAX_SLIDE_PX, depth, slopes)
        seen = seen / (MATCH_FACTOR**2 + MATCH_FLOOR_MM**2 * seen)
        information = seen + known
        joined = np.where(live, (seen * place + known * before) / information, 0.0).astype(np.float32)
        depth, flatter, relief = np.empty_like(joined), np.empty_like(slopes), np.empty_like(joined)
        fit_planes(joined, slopes, information, RADIUS_PX, pixel_mm, STEEPEST * pixel_mm, depth, flatter, relief)
        slopes = flatter
    return Field(depth, slopes, information.astype(np.float32), relief, likeness)


def confirm_depths(crops: Sequence[Crop], stack: Stack, fields: Sequence[Field]) -> tuple[DepthMap, ...]:
    """Compares the full-size fields of all views with each other. Returns a depth map for each view, with only the
    pixels that other views confirm."""
    matched = np.concatenate([(1.0 / np.sqrt(field.information + 1e-6)).ravel() for field in fields])
    depth = np.concatenate([field.depth.ravel() for field in fields])
    slopes = np.concatenate([field.slopes.reshape(-1, 2) for field in fields])

    def work(view: int) -> DepthMap:
        others = np.array([k for k in range(len(crops)) if k != view], dtype=np.int64)
        shape = fields[view].depth.shape
        agreeing, before = np.empty(shape, np.uint8), np.empty(shape, np.uint8)
        apart = np.empty(shape, np.float32)
        count_agreeing(
            int(stack.offset[view]), stack.homographies(view, others), stack.lens[others, :2].copy(), matched, depth,
            slopes, (AGREE_MM, AGREE_DEVIATIONS), agreeing, before, apart,
        )  # fmt: skip
        deviation = stated_deviation(crops[view].camera, fields[view], agreeing, apart)
        clear = (deviation < MAX_DEVIATION_MM) & (stack.image(matched, view) < MAX_DEVIATION_MM)
        inside = stack.image(stack.distance_px, view) < -OUTLINE_PX
        known = inside & clear & (agreeing >= 1) & (MAX_CONTRADICTING_VIEWS * agreeing >= before)
        return _depth_map(crops[view], fields[view], known, deviation, agreeing)

    return tuple(map_in_threads(work, len(crops)))


def stated_deviation(camera: Camera, field: Field, agreeing: UInt8[np.ndarray, "h w"], apart: Plane) -> Plane:
    """Returns the standard deviation (mm) of the depth at each pixel, along the ray.

    ``camera``: camera of the view. ``field``: depths of the view. ``agreeing``: number of other views with the surface
    at the same point. ``apart``: mean squared distance to these views' surfaces, mm^2.
    """
    k = camera.intrinsics
    pixel_mm = np.maximum(field.depth, 1.0) / k.fx
    slant = 1.0 + (field.slopes[:, :, 0] / pixel_mm) ** 2 + (field.slopes[:, :, 1] / pixel_mm) ** 2  # squared secant
    pixel = PIXEL_SHARE * pixel_mm**2 / np.maximum(agreeing.astype(np.float32), 1.0) ** 2
    variance = RELIEF_SHARE * field.relief_mm**2 + slant * (APART_SHARE * apart + pixel)
    return np.sqrt(variance).astype(np.float32)


def _depth_map(
    crop: Crop, field: Field, known: Bool[np.ndarray, "h w"], deviation: Plane, agreeing: UInt8[np.ndarray, "h w"]
) -> DepthMap:
    zero = np.float32(0.0)
    return DepthMap(
        camera=crop.camera,
        depth_mm=np.where(known, field.depth, zero),
        normal=normals_of_known(field.depth, field.slopes, known, *placing(crop.camera)[:2]),
        deviation_mm=np.where(known, deviation, np.float32(np.inf)),
        views=np.where(known, agreeing + 1, 0).astype(np.uint8),
    )


PIXEL_MM = 0.4  # on the subject; finer photographs are reduced to it, for their noise is below 0.1 mm there
CONTRAST_LEVELS = 30.0  # a pixel that differs by this from its window's middle weighs half
MIN_ANGLE_DEG = 8.0  # between the views of a pair: nearer ones determine depth badly
MAX_ANGLE_DEG = 45.0  # farther ones match hair and ears wrongly ...
WIDEST_ANGLE_DEG = 65.0  # ... and are used only where a view has fewer than ``MIN_NEIGHBOURS``
MIN_NEIGHBOURS = 3
MAX_NEIGHBOURS = 5


def choose_neighbours(cameras: Sequence[Camera], at_world: Float[np.ndarray, " 3"]) -> list[Int[np.ndarray, " _"]]:
    """Returns, for each camera, the indices of the cameras to match it with (may be empty), by increasing angle between
    viewing directions.

    Args:
        cameras: of all views.
        at_world: about the middle of the subject (mm), to which the viewing directions point.
    """
    towards = np.stack([camera.centre_world - at_world for camera in cameras])
    towards /= np.maximum(np.linalg.norm(towards, axis=1, keepdims=True), 1e-9)
    angle = np.degrees(np.arccos(np.clip(towards @ towards.T, -1.0, 1.0)))
    chosen = []
    for row in angle:
        order = [k for k in np.argsort(row, kind="stable") if row[k] > MIN_ANGLE_DEG]
        kept = [
            k
            for place, k in enumerate(order)
            if row[k] < MAX_ANGLE_DEG or (place < MIN_NEIGHBOURS and row[k] < WIDEST_ANGLE_DEG)
        ]
        chosen.append(np.array(kept[:MAX_NEIGHBOURS], dtype=np.int64))
    return chosen


def square_pattern(radius_px: int) -> Float32[np.ndarray, "2 s"]:
    """Returns the offsets (across and down, px) of all pixels in a square from its middle."""
    side = np.arange(-radius_px, radius_px + 1, dtype=np.float32)
    down, across = np.meshgrid(side, side, indexing="ij")
    return np.stack([across.ravel(), down.ravel()])


COARSEST_LEVEL = 3  # level of the search's bounds: an eighth of the photographs' size
# By how often the size was doubled since the search. Surface of so few pixels as a speck has is a chance match where
# other surface encloses it; the same area at both sizes. Of what is told of an oily head, 6.5 % lay 2 mm off without
# it, 5.9 % do now; with 200 at the first, ears go.
PASSES = (Pass((1, 3), 60, 2), Pass((1,), 240, 2), Pass((), 0, 1))
DONE = {2: 0.4, 1: 0.6, 0: 0.95}  # share of the work, by level


@traced
def estimate_depth(
    images: Mapping[str, UInt8[np.ndarray, "h w 3"]],
    silhouettes: Mapping[str, Silhouette],
    rig: Rig,
    head_world: Mesh | None,
    *,
    report: Progress,
    device: ComputeDevice | None = None,
) -> tuple[DepthMap, ...]:
    """Computes depth, normal and standard deviation for each photograph by matching it with neighbouring views.

    Args:
        images: RGB, by camera name.
        silhouettes: by camera name; a view whose silhouette is not usable is left out.
        rig: the cameras.
        head_world: the fitted head (world frame, mm), which limits the depths to search; None if there is none.
        report: called with ``"dense"`` and the finished fraction; an exception that it raises stops the work.
        device: GPU that compares the windows; None uses compiled loops.

    Returns:
        One depth map for each view that takes part, in the order of the rig. With fewer than two views no depth is
            known.
    """
    extent = hull_extent(silhouettes, rig)
    report("dense", 0.0)
    crops = make_crops(images, silhouettes, rig, pixel_mm=PIXEL_MM, at_world=extent[0])
    if not crops:
        return ()
    neighbours = choose_neighbours([crop.camera for crop in crops], extent[0])
    pattern = square_pattern(2)
    first = find_search_level([crop.camera for crop in crops], extent[0])
    stack = stack_crops(crops, first)
    depth_ranges = find_depth_ranges(crops, stack_crops(crops, COARSEST_LEVEL), stack, head_world, extent)
    report("dense", 0.1)
    fields: list[Field] = []
    for doublings in range(first + 1):
        level = first - doublings
        if doublings:
            stack = stack_crops(crops, level)
            fields = upsample_fields(fields, stack)
        with matching_on(device, stack, neighbours, pattern, CONTRAST_LEVELS) as matching:
            if not doublings:
                fields = find_fields(matching, depth_ranges)
                report("dense", 0.3)
            fields = refine_fields(fields, matching, PASSES[doublings])
        report("dense", DONE[level])
    found = confirm_depths(crops, stack, fields)
    report("dense", 1.0)
    return found


def find_search_level(cameras: Sequence[Camera], at_world: Float[np.ndarray, " 3"]) -> int:
    """Returns the pyramid level of the first search, at which a pixel is about ``SEARCH_PIXEL_MM`` wide at the subject.

    Args:
        cameras: of the crops at full size; at least one.
        at_world: about the middle of the subject, mm.
    """
    depths = [float(camera.camera_from_world.apply(at_world)[2]) for camera in cameras]
    pixel_mm = np.median([depth / camera.intrinsics.fx for depth, camera in zip(depths, cameras, strict=True)])
    halvings = int(np.rint(np.log2(SEARCH_PIXEL_MM / max(float(pixel_mm), 1e-9))))
    return min(max(halvings, FIRST_LEVELS[0]), FIRST_LEVELS[-1])


def find_fields(matching: Matching, depth_ranges: Sequence[DepthRange]) -> list[Field]:
    """Finds first depths in every view: matches depths at even steps through the range of each pixel, twice. The
    information of the returned fields is 0."""

    def work(view: int) -> Field:
        room, matcher = depth_ranges[view], matching.matcher(view)
        strides = label_strides(room)
        field = _cheapest(matcher.sweep(room, strides, LABELS), room, strides)
        room = slant_bounds(room, field, float(matching.stack.lens[view, 0]))
        return _cheapest(matcher.sweep(room, strides, LABELS), room, strides)

    return map_in_threads(work, len(matching.stack))


def slant_bounds(room: DepthRange, field: Field, lens: float) -> DepthRange:
    """Replaces the slopes of the range's bounds by those of the depths around the pixel where the range is wider than
    ``WIDE_MM``. ``lens`` is the focal length in pixels."""
    live = field.depth > 0.0
    if not live.any():
        return room
    steepest = STEEPEST * float(field.depth[live].mean()) / lens
    slopes = np.clip(slopes_around(field.depth), -steepest, steepest)
    wide = (room.far - room.near > WIDE_MM)[:, :, None]
    return DepthRange(room.near, room.far, np.where(wide, np.concatenate([slopes, slopes], axis=2), room.slopes))


def slopes_around(depth: Float32[np.ndarray, "h w"]) -> Float32[np.ndarray, "h w 2"]:
    """Returns the slopes (mm per pixel, by x and y) of the best-fitting plane of the depths around each pixel. Depths
    of 0 are unknown; at least one must be known."""
    live = depth > 0.0
    row, column = np.mgrid[: depth.shape[0], : depth.shape[1]].astype(np.float64)
    known, height = live.astype(np.float64), np.where(live, depth - depth[live].mean(), 0.0)
    total = np.maximum(cv2.GaussianBlur(known, (0, 0), AROUND_PX), 1e-12)

    def mean(values: Float[np.ndarray, "h w"]) -> Float[np.ndarray, "h w"]:
        return cv2.GaussianBlur(known * values, (0, 0), AROUND_PX) / total

    x, y, z = mean(column), mean(row), mean(height)
    xx, yy, xy = mean(column**2) - x * x + EVEN_PX2, mean(row**2) - y * y + EVEN_PX2, mean(column * row) - x * y
    xz, yz = mean(column * height) - x * z, mean(row * height) - y * z
    slopes = np.stack([yy * xz - xy * yz, xx * yz - xy * xz], axis=2) / (xx * yy - xy * xy)[:, :, None]
    return slopes.astype(np.float32)


def label_strides(room: DepthRange) -> Int32[np.ndarray, "h w"]:
    """Returns the stride (1, 2, 4 and so on) of each pixel: only every stride-th depth label is matched. A narrow range
    needs fewer matched depths for the same spacing in mm."""
    depth = np.clip(room.far - room.near, REACH_MM / LABELS, REACH_MM)
    return (2 ** np.floor(np.log2(REACH_MM / depth))).astype(np.int32)


def _cheapest(cost: Float32[np.ndarray, "h w d"], room: DepthRange, strides: Int32[np.ndarray, "h w"]) -> Field:
    """Returns the field of the depth labels with the least aggregated path cost, each refined within its stride by the
    matching costs."""
    paths = np.empty_like(cost)
    aggregate(cost, room.far > 0.0, STEP_COST, EDGE_COST, paths)
    labels = cost.shape[2]
    best = (paths.argmin(axis=2) + strides // 2) // strides * strides  # a label that was matched
    best = np.clip(best, strides, labels - 1 - strides)
    before, at, after = (
        np.take_along_axis(cost, (best + j * strides)[:, :, None], axis=2)[:, :, 0] for j in (-1, 0, 1)
    )
    within = np.clip(0.5 * (before - after) / np.maximum(before + after - 2.0 * at, 1e-6), -0.5, 0.5)
    share = (best + strides * within) / (labels - 1)
    depth = np.where(room.far > 0.0, room.near + share * (room.far - room.near), 0.0).astype(np.float32)
    slopes = room.slopes[:, :, :2] + share[:, :, None] * (room.slopes[:, :, 2:] - room.slopes[:, :, :2])
    zero = np.zeros_like(depth)
    return Field(depth, slopes.astype(np.float32), zero, zero, zero)
