"""Decides which pixels show the subject in every view of a capture without plates and masks.

Matting must know the background behind the subject's border. With a plain backdrop the pixels beside the subject give a
good estimate. With a cluttered background, or one of the subject's colour, the estimate is bad, and a coarse mask may
be 10 cm too wide. If the background's estimate is bad, the mask is cut along image edges instead: windows along the
outline are segmented one by one with local colours (Rother et al., *GrabCut*, SIGGRAPH 2004, in OpenCV), and
overlapping windows are averaged (Bai et al., *Video SnapCut*, 2009).
"""

from collections.abc import Callable, Mapping
from dataclasses import dataclass
from functools import partial

import cv2
import numpy as np
from jaxtyping import Bool, Float, Float32, UInt8

from pipeline.compute.threads import task_pool
from pipeline.imaging.masks import dilate, erode, fill_holes, spread
from pipeline.multiview.scene_tracks import ScenePoints, find_scene_points
from pipeline.segmentation.background import COARSE_COLUMNS, Background, coarse_size, plate_tolerance
from pipeline.segmentation.foreground import CONCLUSIVE, Decision, colours_apart, find_mixtures, whole_subject
from pipeline.segmentation.mask_kernels import MAX_ODDS
from pipeline.segmentation.without_plates.head_seed import HeadSeed
from pipeline.segmentation.without_plates.mask_search import CoarseMask, head_core, search_masks
from pipeline.segmentation.without_plates.viewing_volume import (
    ViewingVolume,
    ask_other_views,
    build_volume,
    viewing_ball,
)
from rig.rig import Rig

Plane = Float[np.ndarray, " 4"]
Vector = Float[np.ndarray, " 3"]

POINTS_SHARE, MASKS_SHARE = 0.3, 0.6  # of the time, when they are there
POINT_PX = 2  # of the reduced image: what is around a point is the same thing
MIN_LEVEL = 0.8  # cosine between a table's normal and the face's up: a nod of 35 degrees
MAX_PLATE_NOISE = 8.0  # levels by which the guess of a plate may be off; 2 to 4 before the studio's backdrops
ALPHA_BLUR_PX = 1.0  # of the image that was cut
Mask = Bool[np.ndarray, "h w"]

COLUMNS = 640  # of the images that are cut: 2 px of a picture of 1300
WINDOW, STEP = 80, 28  # px of them: side of a window, and from one to the next along the outline
ITERATIONS = 2
DENIED = -6.0  # sum of log odds below which the other views leave nothing of the subject: two of them deny it
MIN_SAMPLES = 30  # pixels of each kind that a window must be sure of
MIN_PIECE = 100  # px of outline


@dataclass(frozen=True, slots=True, eq=False)
class WithoutPlates:
    """Holds the views in two groups: ``decisions`` for matting, and ``shares``, the subject's fraction of each pixel
    (full size) in views that were cut along edges."""

    decisions: Mapping[str, Decision]
    shares: Mapping[str, Float32[np.ndarray, "_ _"]]


def decide_without_plates(
    images: Mapping[str, UInt8[np.ndarray, "_ _ 3"]],
    rig: Rig,
    *,
    head: HeadSeed | None = None,
    report: Callable[[float], None] = lambda share: None,
) -> WithoutPlates:
    """Decides which pixels of every photograph show the subject, without plates. ``head`` is the head's position, or
    None."""
    small = {name: _reduced(images[name], COARSE_COLUMNS).astype(np.float32) for name in rig.names}
    sizes = {name: image.shape[:2] for name, image in small.items()}
    points = find_scene_points(images, rig, report=partial(_between, report, 0.0, POINTS_SHARE))
    ball = viewing_ball(rig, None if head is None else head.centre_world)
    plane = find_standing_plane(points.points, *ball)
    if plane is not None and head is not None and plane[:3] @ head.up_world < MIN_LEVEL:
        plane = None  # a patterned shirt is as flat as a table, but upright
    if plane is not None:
        ball = ball_above(plane, points.points, *ball)
    volume = build_volume(rig, sizes, ball, plane_world=plane)
    background = {
        camera.name: background_seen(points, camera.name, camera.intrinsics.width, sizes[camera.name], volume, plane)
        for camera in rig
    }
    report_masks = partial(_between, report, POINTS_SHARE, MASKS_SHARE)
    found = search_masks(small, rig, volume, background, bounded=plane is not None, head=head, report=report_masks)
    decisions = {
        name: decision_without_plate(images[name], small[name], found[name], solid=head is not None)
        for name in rig.names
    }
    cluttered = {n for n, one in decisions.items() if plane is not None or plate_noise(one) > MAX_PLATE_NOISE}
    if not cluttered:
        return WithoutPlates(decisions, {})
    report_cuts = partial(_between, report, MASKS_SHARE, 1.0)
    reduced = {name: _reduced(images[name], COLUMNS) for name in rig.names}
    cuts = cut_views(reduced, {name: one.mask for name, one in found.items()}, volume, report=report_cuts)
    if head is not None:
        cuts = {name: solid_around(head_core(head, rig[name], cut.shape), cut) for name, cut in cuts.items()}
    shares = {name: _enlarged(cuts[name], images[name].shape[:2]) for name in rig.names if name in cluttered}
    return WithoutPlates({name: one for name, one in decisions.items() if name not in cluttered}, shares)


def background_seen(
    points: ScenePoints, name: str, width: int, size: tuple[int, int], volume: ViewingVolume, plane: Plane | None
) -> Bool[np.ndarray, "h w"]:
    """Returns a mask of the pixels of a reduced image (``size``: height, width) around scene points of the background,
    which are far from the subject, or on the plane under it."""
    seen_points = points.points[points.rows[name]]
    behind = np.linalg.norm(seen_points - volume.centre_world, axis=1) > volume.radius_mm
    if plane is not None:
        behind |= seen_points @ plane[:3] + plane[3] < NEAR * volume.radius_mm
    mask = np.zeros(size, np.uint8)
    for x, y in (points.pixels[name][behind] + 0.5) * (size[1] / width):
        cv2.circle(mask, (int(x), int(y)), POINT_PX, 1, -1)
    return mask.view(bool)


def solid_around(core: Bool[np.ndarray, "h w"], share: Float32[np.ndarray, "h w"]) -> Float32[np.ndarray, "h w"]:
    """Returns the subject's fraction of each pixel in a cut of a person, with the head's ``core`` added and holes
    filled, since a cut may leave out a highlight on a forehead."""
    subject = np.pad(((share > 0.5) | core).view(np.uint8), 1)
    cv2.floodFill(subject, None, (0, 0), 2)
    return np.where(core | ((subject[1:-1, 1:-1] == 0) & (share <= 0.5)), np.float32(1.0), share)


def _reduced(image: UInt8[np.ndarray, "_ _ 3"], columns: int) -> UInt8[np.ndarray, "_ _ 3"]:
    return cv2.resize(image, coarse_size(image.shape, columns), interpolation=cv2.INTER_AREA)


def _enlarged(share: Float32[np.ndarray, "_ _"], size: tuple[int, ...]) -> Float32[np.ndarray, "_ _"]:
    smooth = cv2.GaussianBlur(share, (0, 0), ALPHA_BLUR_PX)
    return cv2.resize(smooth, (size[1], size[0]), interpolation=cv2.INTER_CUBIC)


def _between(report: Callable[[float], None], start: float, end: float, share: float) -> None:
    report(start + (end - start) * share)


MARGIN = 2  # coarse pixels beyond the mask in which the subject may still be
NEARBY_PX = 2.5  # coarse pixels: sigma of the window that the plate is taken from
NOISE_WINDOW_PX = 6.0  # of the window in which the guess is judged
SOLID_ODDS = np.float32(4.0)  # of what a head encloses
MIN_NOISE = 0.7  # levels: what a sensor and 8 bits leave


def decision_without_plate(
    image: UInt8[np.ndarray, "_ _ 3"], coarse: Float32[np.ndarray, "h w 3"], found: CoarseMask, *, solid: bool = False
) -> Decision:
    """Returns a decision for matting, with a background estimated from the pixels around the mask. If ``solid``, the
    subject is a head, and holes in the mask are filled."""
    mask, others = whole_subject(found.mask, found.odds < -1)
    odds = found.odds
    if solid:
        holes = fill_holes(mask) & ~mask
        mask, odds = mask | holes, np.where(holes, np.maximum(odds, SOLID_ODDS), odds)
    outside = ~dilate(mask, MARGIN)
    background = guess_background(image, coarse, outside)
    tolerance = plate_tolerance(background.coarse)
    variance = (background.noise**2 / 4 + tolerance**2).astype(np.float32)
    away, mixture = find_mixtures(image, coarse, background)
    paint = spread(coarse, erode(mask, 1) * away / (1 + mixture**2), 2.0)
    clear = colours_apart(paint, background.coarse, variance) > CONCLUSIVE
    mixed = (mixture > 1) & (away > (2 * background.noise.mean(axis=2)) ** 2)
    probability = 1 / (1 + np.exp(-odds.astype(np.float64)))
    plain = outside & False
    return Decision(coarse, background, odds, probability, mask, others, paint, odds, clear, plain, mixed)


def guess_background(
    image: UInt8[np.ndarray, "_ _ 3"], coarse: Float32[np.ndarray, "h w 3"], outside: Bool[np.ndarray, "h w"]
) -> Background:
    """Estimates the background behind the subject from the pixels ``outside``; its noise includes the estimate's
    error."""
    guess = spread(coarse, outside.astype(np.float32), NEARBY_PX)
    size = (image.shape[1], image.shape[0])
    share = cv2.resize(cv2.GaussianBlur(outside.astype(np.float32), (0, 0), 1.0), size, interpolation=cv2.INTER_LINEAR)
    behind = cv2.resize(guess, size, interpolation=cv2.INTER_LINEAR)
    seen = np.clip(2 * share[:, :, None] - 1, 0, 1)
    plate = np.rint(np.clip(seen * image + (1 - seen) * behind, 0, 255)).astype(np.uint8)
    far = outside & ~dilate(~outside, 2)
    test = spread(coarse, far.astype(np.float32), NEARBY_PX)
    ring = (outside & ~far).astype(np.float32)
    error = np.sqrt(spread((coarse - test) ** 2, ring, NOISE_WINDOW_PX))
    pixel = _pixel_noise(image)
    noise = np.sqrt(error**2 + np.maximum(pixel, MIN_NOISE) ** 2).astype(np.float32)
    small = cv2.resize(plate, (coarse.shape[1], coarse.shape[0]), interpolation=cv2.INTER_AREA).astype(np.float32)
    return Background(plate[None], np.ones_like(coarse), small, noise, outside, np.ones(3, np.float32))


def _pixel_noise(image: UInt8[np.ndarray, "h w 3"]) -> Float32[np.ndarray, " 3"]:
    """Estimates the noise (levels) of a pixel in each channel from differences of neighbouring pixels, most of which
    lie on no edge."""
    steps = image[::4, 1:].astype(np.float32) - image[::4, :-1]
    return (1.4826 * np.median(np.abs(steps), axis=(0, 1)) / np.sqrt(2)).astype(np.float32)


def plate_noise(decision: Decision) -> float:
    """Returns the median noise (levels) of the estimated background along the subject's border; 0 without a border."""
    rim = dilate(decision.mask, MARGIN) & ~erode(decision.mask, MARGIN)
    return float(np.median(decision.background.noise[rim])) if rim.any() else 0.0


TRIPLES, SAMPLES = 20000, 2000  # drawn; of those far enough apart, tried
OUTER, APART = 0.35, 0.4  # of the radius: how far from the middle, and from each other, the points of a sample are
NEAR = 0.012  # of the volume's radius: how far a point of the plane may be from it; 3 mm of a head's picture
MIN_POINTS, MIN_SHARE = 40, 0.08  # that lie on it; 0.11 of the Buddha's
MAX_BEYOND = 0.01  # share of the points within the volume that may lie on its other side
MIN_WIDTH = 0.45  # of the radius: root mean square distance of its points from their middle; of a face 0.25
OUTLYING, ROOM = 0.01, 1.2  # share of points that are wrong; of their distance, room for what shows none
MIN_OFF_CENTRE = 0.08  # of the radius: the place that all cameras look at is not on it


def find_standing_plane(points_world: Float[np.ndarray, "n 3"], centre_world: Vector, radius_mm: float) -> Plane | None:
    """Finds the plane on which the subject stands: it contains many scene points, and hardly any lie behind it. ``plane
    . (x, 1)`` is the distance (mm), positive on the subject's side; None if no plane is found."""
    near = points_world[np.linalg.norm(points_world - centre_world, axis=1) < 2 * radius_mm]
    if len(near) < MIN_POINTS:
        return None
    rng = np.random.default_rng(0)
    best, most = None, 0
    outer = near[np.linalg.norm(near - centre_world, axis=1) > OUTER * radius_mm]
    if len(outer) < 3:
        return None
    triples = outer[rng.integers(len(outer), size=(TRIPLES, 3))]
    sides = np.linalg.norm(triples - np.roll(triples, 1, axis=1), axis=2).min(axis=1)
    for three in triples[sides > APART * radius_mm][:SAMPLES]:
        plane = _through(three, centre_world)
        if plane is None or plane[:3] @ centre_world + plane[3] < MIN_OFF_CENTRE * radius_mm:
            continue
        count = int((np.abs(near @ plane[:3] + plane[3]) < NEAR * radius_mm).sum())
        if count > most and _holds(plane, near, centre_world, radius_mm):
            best, most = plane, count
    return None if best is None else _refined(best, near, centre_world, radius_mm)


def ball_above(
    plane_world: Plane, points_world: Float[np.ndarray, "n 3"], centre_world: Vector, radius_mm: float
) -> tuple[Vector, float]:
    """Returns the centre (world frame) and radius (mm) of a ball around the scene points above the plane, with a margin
    for parts without points."""
    height = points_world @ plane_world[:3] + plane_world[3]
    inside = np.linalg.norm(points_world - centre_world, axis=1) < radius_mm
    standing = points_world[inside & (height > 2 * NEAR * radius_mm)]
    if len(standing) < MIN_POINTS:
        return centre_world, radius_mm
    low, high = np.quantile(standing, (OUTLYING, 1 - OUTLYING), axis=0)
    middle = 0.5 * (low + high)
    away = np.linalg.norm(standing - middle, axis=1)
    return middle, min(radius_mm, ROOM * float(np.quantile(away, 1 - OUTLYING)))


def _holds(plane: Plane, points: Float[np.ndarray, "n 3"], centre: Vector, radius: float) -> bool:
    height = points @ plane[:3] + plane[3]
    on = points[np.abs(height) < NEAR * radius]
    inside = np.linalg.norm(points - centre, axis=1) < radius
    if len(on) < max(MIN_POINTS, MIN_SHARE * len(points)):
        return False
    spread = np.sqrt(((on - on.mean(axis=0)) ** 2).sum(axis=1).mean())
    beyond = (height[inside] < -2 * NEAR * radius).mean() if inside.any() else 1.0
    return bool(spread > MIN_WIDTH * radius and beyond < MAX_BEYOND)


def _through(three: Float[np.ndarray, "3 3"], centre: Vector) -> Plane | None:
    normal = np.cross(three[1] - three[0], three[2] - three[0])
    length = float(np.linalg.norm(normal))
    if length < 1e-9:
        return None
    plane = np.append(normal, -normal @ three[0]) / length
    return plane if plane[:3] @ centre + plane[3] > 0 else -plane


def _refined(plane: Plane, points: Float[np.ndarray, "n 3"], centre: Vector, radius: float) -> Plane:
    """Refines a plane by least squares over the points near it."""
    for _ in range(3):
        on = points[np.abs(points @ plane[:3] + plane[3]) < NEAR * radius]
        middle = on.mean(axis=0)
        normal = np.linalg.svd(on - middle)[2][2]
        plane = np.append(normal, -normal @ middle)
        plane = plane if plane[:3] @ centre + plane[3] > 0 else -plane
    return plane


@dataclass(frozen=True, slots=True)
class Bands:
    """Holds the widths (pixels of the cut images) of the bands inside and outside an outline in which its edge is
    searched."""

    inside: int
    outside: int


BANDS = (Bands(14, 8), Bands(8, 6))
"""Of the first cut, whose masks are of the coarse level, and of the second."""


def cut_along(image: UInt8[np.ndarray, "h w 3"], mask: Mask, bands: Bands) -> Float32[np.ndarray, "h w"]:
    """Segments the image in windows along the mask's outline. Returns, for each pixel, the weighted fraction of windows
    that assign it to the subject; a window has more weight near its middle."""
    height, width = mask.shape
    inner, outer = erode(mask, bands.inside), ~dilate(mask, bands.outside)
    side = min(WINDOW, height, width)
    row, column = np.mgrid[:side, :side] - (side - 1) / 2
    weight = np.exp(-(row**2 + column**2) / (2 * (side / 4) ** 2)).astype(np.float32)
    votes, total = np.zeros(mask.shape, np.float32), np.zeros(mask.shape, np.float32)
    outlines, _ = cv2.findContours(mask.view(np.uint8), cv2.RETR_EXTERNAL, cv2.CHAIN_APPROX_NONE)
    for outline in outlines:
        if len(outline) < MIN_PIECE:
            continue
        for x, y in outline[::STEP, 0]:
            left, top = int(np.clip(x - side // 2, 0, width - side)), int(np.clip(y - side // 2, 0, height - side))
            part = (slice(top, top + side), slice(left, left + side))
            found = _cut(image[part], mask[part], inner[part], outer[part])
            if found is not None:
                votes[part] += weight * found
                total[part] += weight
    share = np.where(total > 0, votes / np.maximum(total, 1e-6), mask).astype(np.float32)
    share[inner], share[outer] = 1.0, 0.0
    return share


def _cut(image: UInt8[np.ndarray, "h w 3"], mask: Mask, inner: Mask, outer: Mask) -> Mask | None:
    """Segments one window into subject and background. Returns None if too few pixels are certainly subject or
    background."""
    if min(np.count_nonzero(inner), np.count_nonzero(outer)) < MIN_SAMPLES:
        return None
    kinds = np.where(mask, cv2.GC_PR_FGD, cv2.GC_PR_BGD).astype(np.uint8)
    kinds[inner], kinds[outer] = cv2.GC_FGD, cv2.GC_BGD
    cv2.setRNGSeed(0)  # of this thread: the colours' first clusters are drawn
    background, subject = np.zeros((1, 65)), np.zeros((1, 65))
    box, how = (0, 0, 1, 1), cv2.GC_INIT_WITH_MASK
    cv2.grabCut(np.ascontiguousarray(image), kinds, box, background, subject, ITERATIONS, how)
    return (kinds == cv2.GC_FGD) | (kinds == cv2.GC_PR_FGD)


def cut_views(
    images: Mapping[str, UInt8[np.ndarray, "_ _ 3"]],
    masks: Mapping[str, Bool[np.ndarray, "_ _"]],
    volume: ViewingVolume,
    *,
    report: Callable[[float], None],
) -> dict[str, Float32[np.ndarray, "_ _"]]:
    """Returns the subject's fraction of each pixel in every view, at the size of ``images``. ``volume`` belongs to the
    size of ``masks``."""
    wide = {name: _resized(mask, images[name].shape[:2]) for name, mask in masks.items()}
    shares: dict[str, Float32[np.ndarray, "_ _"]] = {}
    for step, bands in enumerate(BANDS):
        if step:
            wide = _carved(shares, masks, volume)
        with task_pool() as pool:
            cuts = {name: pool.submit(cut_along, images[name], wide[name], bands) for name in images}
            for count, (name, cut) in enumerate(cuts.items(), 1):
                shares[name] = cut.result()
                report((step + count / len(cuts)) / len(BANDS))
    return shares


def _carved(
    shares: Mapping[str, Float32[np.ndarray, "_ _"]],
    masks: Mapping[str, Bool[np.ndarray, "_ _"]],
    volume: ViewingVolume,
) -> dict[str, Bool[np.ndarray, "_ _"]]:
    """Removes from the cut masks the pixels that the masks of other views exclude."""
    odds = {
        name: (MAX_ODDS * (2 * cv2.resize(share, masks[name].shape[::-1], interpolation=cv2.INTER_AREA) - 1))
        for name, share in shares.items()
    }
    others = ask_other_views(volume, odds)
    return {
        name: (share > 0.5) & ~_resized(others[name].support < DENIED, share.shape) for name, share in shares.items()
    }


def _resized(mask: Bool[np.ndarray, "_ _"], size: tuple[int, ...]) -> Bool[np.ndarray, "_ _"]:
    smooth = cv2.resize(mask.astype(np.float32), (size[1], size[0]), interpolation=cv2.INTER_LINEAR)
    return smooth > 0.5
