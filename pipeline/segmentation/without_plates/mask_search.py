"""Finds coarse masks of all views together, from colour models and from the consistency between views.

The search starts with a disc of certain subject around the point to which all cameras are directed. The image border is
background, except at the bottom, where the body leaves the image. After this start two steps alternate: colour models
give log odds, and the views are combined in a voxel volume. A view's background colours are first learned from the
image border. Later the background colours are learned from pixels outside its mask that other views also exclude, so
that a coat which is not yet in the mask does not become background.

Each view has its own background colours. The subject's colour density is the mean of two densities, over all views and
over the view alone, since the light may differ between views. If subject and background have similar colours (a grey
coat in front of a grey wall), local colours distinguish them better. Therefore each histogram is combined with a
Gaussian of the colours in a window (as in Bai et al., *Video SnapCut*, SIGGRAPH 2009).
"""

from collections.abc import Callable, Mapping
from dataclasses import dataclass

import cv2
import numpy as np
from jaxtyping import Bool, Float, Float32
from scipy.ndimage import gaussian_filter

from pipeline.imaging.masks import dilate, erode, spread
from pipeline.multiview.upright import guessed_up
from pipeline.segmentation.mask_kernels import MAX_ODDS, mean_field_sweeps
from pipeline.segmentation.without_plates.head_seed import HeadSeed, beside_head, head_core
from pipeline.segmentation.without_plates.viewing_volume import OtherViews, ViewingVolume, ask_other_views, reachable
from rig.camera import Camera
from rig.rig import Rig

Picture = Float32[np.ndarray, "h w 3"]
Vector = Float[np.ndarray, " 3"]

ROUNDS = 8  # masks of the studio do not change after the sixth
BORDER_ROUNDS = 1  # in which the background is what the border shows, no more
LOCAL_ROUNDS = 4  # after which the colours nearby count
CORE = 0.11  # of the image's smaller side: radius of the disc that is surely subject
BORDER = 0.05  # of the same: width of the strip that is surely background ...
BODY_SIDE = 0.3  # ... above this share of the way from the middle to the lower border, where a body may leave
LEVEL = 0.5  # sine of the angle between view and up below which no side of the image is the lower one
SUPPORT_WEIGHT, MAX_SUPPORT, MAX_DENIAL = 0.5, 1.0, 5.0  # of what the other views say, in log odds
SOLID_ODDS = 3.0  # that a pixel gains where every other view has the subject
CORE_ODDS, BORDER_ODDS = 2.0, -1.0
FACE_ODDS = 10.0  # of a core that a found face is: highlights have the colour of a bright wall
LINK, LINK_NOISE, SWEEPS = 0.7, 2.0, 12  # of neighbours: log odds, noise levels that hardly count as an edge
MAX_GREY = 2.0  # levels by which the channels of a grey photograph differ
TEXTURE_PX, TEXTURE_GAIN = 2.0, 4.0  # sigma of the window; scatter by it counts like a colour
MIN_SAMPLES = 50  # pixels that a background is learnt from

Mask = Bool[np.ndarray, "h w"]
BINS = 24  # a channel: 11 levels
HISTOGRAM_BLUR = 0.8  # bins, standard deviation
UNSEEN = 1e-5  # share of a colour that was never seen: unknown, not impossible
NEARBY_PX = 6.0  # of the reduced image: sigma of the window of local colours
MIN_SCATTER = 2.0  # levels: folds and weave of a cloth are no less
SUBJECT_SCATTER = 1.5  # by which the subject's shading is rougher than that
LOG_CELL = 3 * np.log(BINS / 256)  # log of one over a bin's volume, levels^-3
MAX_COLOUR_ODDS = 5.0


@dataclass(frozen=True, slots=True, eq=False)
class Samples:
    """Holds masks of the pixels of a reduced image that certainly show the subject, and certainly show background."""

    subject: Mask
    background: Mask


@dataclass(frozen=True, slots=True, eq=False)
class Seeds:
    """Holds three masks of a view that follow from geometry: certain subject, certain background, and possible
    subject."""

    core: Mask
    border: Mask
    reachable: Mask
    core_odds: float = CORE_ODDS


@dataclass(frozen=True, slots=True, eq=False)
class CoarseMask:
    """Holds the log odds of the subject from colours, neighbours and other views, and the resulting connected
    ``mask``."""

    odds: Float32[np.ndarray, "h w"]
    mask: Mask
    other_views: OtherViews


def find_seeds(
    camera: Camera, volume: ViewingVolume, up_world: Vector, size: tuple[int, int], head: HeadSeed | None = None
) -> Seeds:
    """Computes the geometric masks of a view whose reduced image has ``size`` (height, width)."""
    height, width = size
    row, column = np.mgrid[:height, :width]
    middle = (camera.project(volume.centre_world[None])[0] + 0.5) * (width / camera.intrinsics.width) - 0.5
    core = np.hypot(column - middle[0], row - middle[1]) < CORE * min(size)
    if head is not None:
        core = head_core(head, camera, size)
    strip = max(3, round(BORDER * min(size)))
    border = np.ones(size, bool)
    border[strip:-strip, strip:-strip] = False
    down = -(camera.camera_from_world.rotation @ up_world)[:2]
    if np.linalg.norm(down) > LEVEL:
        along = (column - width / 2) * down[0] + (row - height / 2) * down[1]
        border &= along < BODY_SIDE * 0.5 * (abs(down[0]) * width + abs(down[1]) * height)
    if head is not None:
        border |= beside_head(head, camera, size)
        return Seeds(core, border & ~core, reachable(volume, camera.name, size), FACE_ODDS)
    return Seeds(core, border & ~core, reachable(volume, camera.name, size))


def search_masks(
    images: Mapping[str, Float32[np.ndarray, "_ _ 3"]],
    rig: Rig,
    volume: ViewingVolume,
    background: Mapping[str, Bool[np.ndarray, "_ _"]],
    *,
    bounded: bool,
    head: HeadSeed | None = None,
    report: Callable[[float], None],
) -> dict[str, CoarseMask]:
    """Finds the subject's mask in every reduced image. ``background``: pixels that certainly do not show the subject.
    ``bounded``: whether the volume contains the whole subject, so that pixels outside it become background in an early
    round."""
    up = guessed_up(rig) if head is None else head.up_world
    sizes = {name: image.shape[:2] for name, image in images.items()}
    seeds = {camera.name: find_seeds(camera, volume, up, sizes[camera.name], head) for camera in rig}
    known = {name: seed.border | ~seed.reachable | (background[name] & ~seed.core) for name, seed in seeds.items()}
    images = {name: _with_texture(image) for name, image in images.items()}
    noise = {name: _noise(image) for name, image in images.items()}
    samples = {name: Samples(seed.core, known[name]) for name, seed in seeds.items()}
    found: dict[str, CoarseMask] = {}
    for step in range(ROUNDS):
        report(step / ROUNDS)
        common = np.sum([histogram(images[name][sample.subject]) for name, sample in samples.items()], axis=0)
        local = step >= (BORDER_ROUNDS if bounded else LOCAL_ROUNDS)
        odds = {}
        for name, image in images.items():
            evidence = colour_odds(image, samples[name], common, noise[name], nearby=local)
            evidence = np.where(known[name], evidence + BORDER_ODDS, evidence)
            odds[name] = np.where(seeds[name].reachable, evidence, -MAX_ODDS).astype(np.float32)
        start = {name: mask.odds for name, mask in found.items()} if local else odds
        for _ in range(2):
            other_views = ask_other_views(volume, start)
            found = {
                name: _with_neighbours(image, odds[name], other_views[name], seeds[name], noise[name])
                for name, image in images.items()
            }
            start = {name: mask.odds for name, mask in found.items()}
        samples = {name: _learn(mask, known[name], border=step < BORDER_ROUNDS) for name, mask in found.items()}
    return found


def _with_neighbours(
    image: Picture, odds: Float32[np.ndarray, "h w"], other_views: OtherViews, seeds: Seeds, noise: Vector
) -> CoarseMask:
    combined = (
        odds + np.clip(SUPPORT_WEIGHT * other_views.support, -MAX_DENIAL, MAX_SUPPORT) + SOLID_ODDS * other_views.solid
    )
    combined = np.where(seeds.reachable, combined + seeds.core_odds * seeds.core, -MAX_ODDS)
    combined = np.clip(combined, -MAX_ODDS, MAX_ODDS).astype(np.float32)
    smooth = mean_field_sweeps(combined, (image / (LINK_NOISE * noise)).astype(np.float32), LINK, SWEEPS)
    smooth = np.asarray(2 * smooth, np.float32)
    return CoarseMask(smooth, _one_piece(smooth > 0, seeds.core), other_views)


def _learn(found: CoarseMask, known: Mask, *, border: bool) -> Samples:
    inner = erode(found.mask, 1)
    subject = inner if inner.any() else found.mask
    if border:
        return Samples(subject, known)
    background = (~dilate(found.mask, 2) & (found.other_views.support < 0)) | (known & ~found.mask)
    return Samples(subject, background if background.sum() >= MIN_SAMPLES else known)


def _one_piece(mask: Mask, core: Mask) -> Mask:
    """Returns the component of the mask that contains most of the core or, if none does, the largest component."""
    count, labels = cv2.connectedComponents(mask.view(np.uint8), connectivity=4)
    if count < 2:
        return mask
    sizes = np.bincount(labels[core & mask], minlength=count)
    sizes = sizes if sizes[1:].any() else np.bincount(labels.ravel(), minlength=count)
    return labels == 1 + int(np.argmax(sizes[1:]))


def _with_texture(image: Picture) -> Picture:
    """Replaces two channels of a grey photograph by the local mean and scatter, as texture features; returns colour
    photographs unchanged."""
    if np.ptp(image, axis=2).max() > MAX_GREY:
        return image
    grey = image[:, :, 0]
    mean = cv2.GaussianBlur(grey, (0, 0), TEXTURE_PX)
    scatter = np.sqrt(np.maximum(cv2.GaussianBlur(grey * grey, (0, 0), TEXTURE_PX) - mean * mean, 0))
    return cv2.merge([grey, mean, np.minimum(TEXTURE_GAIN * scatter, 255)])


def _noise(image: Picture) -> Vector:
    """Estimates the noise (levels) of each channel, at least 1, from differences of neighbouring pixels; fine texture
    counts as noise."""
    return np.maximum(1.4826 * np.median(np.abs(np.diff(image, axis=1)), axis=(0, 1)) / np.sqrt(2), 1.0)


def histogram(colours: Float32[np.ndarray, "n 3"]) -> Float32[np.ndarray, "b b b"]:
    """Counts the pixels in each bin of a colour histogram."""
    counts = np.zeros((BINS,) * 3, np.float32)
    np.add.at(counts, tuple(_bins(colours).T), 1.0)
    return counts


def colour_odds(
    image: Picture,
    samples: Samples,
    common: Float32[np.ndarray, "b b b"],
    noise: Float[np.ndarray, " 3"],
    *,
    nearby: bool,
) -> Float32[np.ndarray, "h w"]:
    """Returns the log odds of subject against background for every pixel, from its colour.

    ``image``: reduced image. ``samples``: certain pixels. ``common``: the subject's colour histogram over all views.
    ``noise``: standard deviation in grey levels. ``nearby``: whether local colour models are used, which need nearly
    complete samples.
    """
    subject = _log_density(image, (common, histogram(image[samples.subject])))
    background = _log_density(image, (histogram(image[samples.background]),))
    if nearby:
        scatter = np.maximum(noise, MIN_SCATTER).astype(np.float32)
        subject = np.logaddexp(subject, _log_nearby(image, samples.subject, SUBJECT_SCATTER * scatter)) - np.log(2)
        background = np.logaddexp(background, _log_nearby(image, samples.background, scatter)) - np.log(2)
    return np.clip(subject - background, -MAX_COLOUR_ODDS, MAX_COLOUR_ODDS).astype(np.float32)


def _bins(colours: np.ndarray) -> np.ndarray:
    return np.clip(colours * (BINS / 256), 0, BINS - 1).astype(np.int32)


def _log_density(image: Picture, counts: tuple[Float32[np.ndarray, "b b b"], ...]) -> Float[np.ndarray, "h w"]:
    """Returns the logarithm of the mean density (levels^-3) of several histograms at each pixel's colour."""
    density = np.zeros((BINS,) * 3)
    for one in counts:
        smooth = gaussian_filter(one, HISTOGRAM_BLUR, mode="constant")
        density += smooth / max(float(smooth.sum()), 1e-9) / len(counts)
    return np.log(density[tuple(np.moveaxis(_bins(image), 2, 0))] + UNSEEN) + LOG_CELL


def _log_nearby(image: Picture, mask: Mask, scatter: Float32[np.ndarray, " 3"]) -> Float[np.ndarray, "h w"]:
    """Returns the log density (levels^-3) of each pixel's colour under a Gaussian of the colours of ``mask`` near the
    pixel."""
    weight = mask.astype(np.float32)
    mean, square = spread(image, weight, NEARBY_PX), spread(image * image, weight, NEARBY_PX)
    variance = np.maximum(square - mean * mean, 0) + scatter**2
    return -0.5 * ((image - mean) ** 2 / variance + np.log(2 * np.pi * variance)).sum(axis=2)
