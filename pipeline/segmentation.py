"""Background subtraction (section 5.4): a capture to one silhouette a camera.

Decisions are taken at a coarse level, where averaging quarters the noise: log odds against the plate as it would look
now (``pipeline.background``), a soft shadow being no subject, made smooth by mean-field sweeps whose links are cut
where the *difference* to the plate has an edge (Sun et al., *Background Cut*, ECCV 2006), so that edges of the backdrop
cut nothing. ``pipeline.matting`` then finds the sub-pixel contour, and ``pipeline.agreement`` asks the other cameras.

The paper says only "background subtraction". A view whose mask cannot be trusted is reported: ``quality.usable`` is
False where it would hurt a fit, and ``quality.warnings`` say why. Operator masks override everything.
"""

from collections.abc import Callable
from concurrent.futures import ThreadPoolExecutor
from dataclasses import replace

import cv2
import numpy as np
from jaxtyping import Bool, Float32, UInt8
from numba import njit

from pipeline.agreement import judge_agreement
from pipeline.background import Background, coarse_size, estimate_background
from pipeline.contour_distance import distance_to_level
from pipeline.matting import Matte, dilated, eroded, solve_matte
from pipeline.settings import SegmentationSettings
from pipeline.silhouette import Silhouette, ViewQuality, silhouette_from_mask
from rig.capture import Capture
from rig.errors import InputError
from rig.layout import Rig

ImageRgb = UInt8[np.ndarray, "h w 3"]
SWEEPS = 12  # of the mean field; the masks of the tests do not change after the eighth
MOST_ODDS = 6.0  # log odds are clipped there, so that one pixel cannot outvote its eight neighbours for ever
SHADOW_CHI2 = 11.3  # three channels, 99 %: what still counts as a darker piece of the plate
SOFT_SHARE = 0.75  # depth of a shadow 2 coarse pixels inside its border by that of its middle; a hard edge has 1
CLOSING = 2  # coarse pixels
STRANGER_SHARE = 3e-4  # of the subject: smaller pieces are noise
SOFT_ONSET = 4.0  # strength that a penumbra has reached 2 coarse pixels inside its border; a coat has 8 and more
TRUE_GAP = -0.9 * MOST_ODDS  # mean log odds of a hole that is background, and not nearly so
NOISE_HOLE = 12  # pixels: a hole of this size in alpha is noise
HAIR_GAP = -0.4 * MOST_ODDS  # the same within HAIR_DEPTH of the outline
HAIR_DEPTH = 6  # coarse pixels (24 px)
SPECK = 3  # coarse pixels: a hole of this size is noise wherever it is
LEAST_GAIN, MOST_GAIN = 0.5, 2.0  # one stop of exposure between plate and shot; beyond that it is another scene


def segment(
    capture: Capture, rig: Rig, settings: SegmentationSettings, *, report: Callable[[str, float], None]
) -> dict[str, Silhouette]:
    """The silhouette of every camera of the rig. Raises InputError where a camera has neither plate nor mask."""
    blind = [name for name in rig.names if name not in capture.masks and not capture.backgrounds.get(name)]
    if blind:
        raise InputError(
            "capture", [f"{name} has neither a clean plate nor a mask: record one of them" for name in blind]
        )
    silhouettes: dict[str, Silhouette] = {}
    with ThreadPoolExecutor(max_workers=2) as pool:  # cv2 and the compiled kernels release the interpreter lock
        jobs = {name: pool.submit(_segment_camera, capture, name, settings) for name in rig.names}
        for name, job in jobs.items():
            silhouettes[name] = job.result()
            report("segmentation", 0.9 * len(silhouettes) / len(rig))
    agreed = judge_agreement(silhouettes, rig, settings)
    report("segmentation", 1.0)
    return agreed


def _segment_camera(capture: Capture, name: str, settings: SegmentationSettings) -> Silhouette:
    if name in capture.masks:
        given = silhouette_from_mask(capture.masks[name])
        return replace(given, quality=_mask_quality(given.mask, settings))
    return segment_view(capture.images[name], capture.backgrounds[name], settings)


def segment_view(image: ImageRgb, plates: tuple[ImageRgb, ...], settings: SegmentationSettings) -> Silhouette:
    """The silhouette of one image against its clean plates."""
    size = coarse_size(image.shape, settings.coarse_columns)
    coarse = cv2.resize(image, size, interpolation=cv2.INTER_AREA).astype(np.float32)
    background = estimate_background(image, coarse, plates, settings)
    reduction = image.shape[1] / size[0]
    odds, shadow = log_odds(coarse, background, reduction, settings)
    odds = np.where(shadow, -MOST_ODDS / 2, odds).astype(np.float32)
    residual = (coarse - background.coarse) / np.maximum(background.noise, 1.0)
    probability = 1 / (1 + np.exp(-2 * _mean_field(odds, residual.astype(np.float32), settings.smoothness, SWEEPS)))
    mask, strangers = _subject_only(_closed(probability > 0.5), odds, settings)
    if mask.mean() < settings.least_area:
        return _nothing(image.shape[:2], background)
    solid = np.where(mask, np.maximum(probability, 0.6), np.minimum(probability, 0.4)).astype(np.float32)
    matte = solve_matte(image, coarse, background, solid, settings)
    return _silhouette(matte, strangers, background, settings)


def log_odds(
    image: Float32[np.ndarray, "h w 3"], background: Background, reduction: float, settings: SegmentationSettings
) -> tuple[Float32[np.ndarray, "h w"], Bool[np.ndarray, "h w"]]:
    """Log odds (clipped) of subject against plate at the coarse level, and where a soft shadow explains the pixel."""
    plate = background.coarse
    difference = image - plate
    measured = 1.4826 * np.median(np.abs(difference[background.inliers]), axis=0) if background.inliers.any() else 0.0
    noise = np.maximum(background.noise / reduction, measured)  # JPEG and demosaicing leave noise that does not average
    variance = noise**2 + (settings.tolerance_levels + settings.tolerance_share * plate) ** 2
    three = np.ones(3, np.float32)  # a product with it sums the channels ten times faster than .sum(axis=2)
    chi2 = (difference**2 / variance) @ three
    ratio = ((image * plate / variance) @ three) / np.maximum((plate**2 / variance) @ three, 1e-6)
    depth = 1 - np.clip(ratio, settings.darkest_shadow, 1.0)
    shaded = (1 - depth)[:, :, None] * plate
    slack = variance + (settings.shadow_chroma * depth[:, :, None] * plate) ** 2
    candidate = (((image - shaded) ** 2 / slack) @ three < SHADOW_CHI2) & (depth > 0)
    odds = np.clip(0.5 * chi2 - settings.evidence, -MOST_ODDS, MOST_ODDS)
    # The same surface in shade is darker in proportion, and so is its texture: compare with that of the shaded plate.
    texture = _detail(image), _detail(shaded.astype(np.float32))
    strength = np.sqrt(chi2 / (2 * settings.evidence)).astype(np.float32)
    shadow = _soft_shadows(candidate & (odds > 0), depth.astype(np.float32), strength, texture, float(noise.mean()))
    return odds.astype(np.float32), shadow


def _soft_shadows(
    candidate: Bool[np.ndarray, "h w"],
    depth: Float32[np.ndarray, "h w"],
    strength: Float32[np.ndarray, "h w"],
    texture: tuple[Float32[np.ndarray, "h w"], Float32[np.ndarray, "h w"]],
    noise: float,
) -> Bool[np.ndarray, "h w"]:
    """Candidates that behave like a shadow: their border to the plain background is soft, and what the plate shows
    there in detail (``texture``: image, plate) goes on under them. A dark coat begins at once and hides the plate.
    ``strength`` is the difference to the plate, 1 where it is first noticed."""
    inward = cv2.distanceTransform((strength > 1).view(np.uint8), cv2.DIST_L2, cv2.DIST_MASK_5)
    count, components = cv2.connectedComponents(candidate.view(np.uint8), connectivity=4)
    labels = np.asarray(components, np.int32)
    reach = np.zeros(count, np.float32)
    np.maximum.at(reach, labels[candidate], inward[candidate])
    # The first ring is partly background even at a hard edge; the second is as deep as the middle if the edge is hard.
    rings = (inward > 1.2) & (inward < 2.6), inward > np.maximum(4.0, 0.6 * reach)[labels]
    (shallow, many), (deep, middle) = (_means(depth, ring & candidate, labels, count) for ring in rings)
    onset, _ = _means(strength, rings[0] & candidate, labels, count)
    enough = (many >= 4) & (middle >= 4) & (onset < SOFT_ONSET)
    seen, plate = texture
    shared, pixels = _means(seen * plate, candidate, labels, count)
    detail, _ = _means(plate * plate, candidate, labels, count)
    unsure = 3 * noise * np.sqrt(detail / np.maximum(pixels, 1))
    hidden, shown = shared + unsure < 0.5 * detail, shared - unsure > 0.6 * detail
    soft = enough & ~hidden & (shown | (shallow < SOFT_SHARE * deep))
    soft[0] = False
    return soft[labels]


def _means(
    values: Float32[np.ndarray, "h w"], where: Bool[np.ndarray, "h w"], labels: np.ndarray, count: int
) -> tuple[np.ndarray, np.ndarray]:
    """Mean of the values of each component, and how many pixels it is over."""
    sizes = np.bincount(labels[where], minlength=count)
    return np.bincount(labels[where], values[where], count) / np.maximum(sizes, 1), sizes


def _detail(image: Float32[np.ndarray, "h w 3"]) -> Float32[np.ndarray, "h w"]:
    """Brightness without what is smoother than the texture of a backdrop."""
    grey = image @ np.full(3, 1 / 3, np.float32)
    return grey - cv2.GaussianBlur(grey, (0, 0), 4.0)


@njit(cache=True, nogil=True)
def _mean_field(odds: np.ndarray, residual: np.ndarray, strength: float, sweeps: int) -> np.ndarray:
    """Half log odds after mean-field sweeps over eight neighbours, in alternating order (Gauss-Seidel)."""
    height, width = odds.shape
    steps = ((0, 1), (1, 0), (1, 1), (1, -1))
    links = np.zeros((4, height, width), np.float32)
    for y in range(height):
        for x in range(width):
            for k in range(4):
                v, u = y + steps[k][0], x + steps[k][1]
                if v < height and 0 <= u < width:
                    square = 0.0
                    for c in range(residual.shape[2]):
                        square += (residual[y, x, c] - residual[v, u, c]) ** 2
                    links[k, y, x] = strength * np.exp(-square / 18.0) * (1.0 if k < 2 else 0.7071)
    field = 0.5 * odds
    mean = np.tanh(field)
    asked = _undecided(odds)
    for sweep in range(sweeps):
        for step in range(len(asked)):
            place = asked[step] if sweep % 2 == 0 else asked[len(asked) - 1 - step]
            y, x = place // width, place % width
            total = 0.5 * odds[y, x]
            for k in range(4):
                dy, dx = steps[k]
                if y + dy < height and 0 <= x + dx < width:
                    total += links[k, y, x] * mean[y + dy, x + dx]
                if y - dy >= 0 and 0 <= x - dx < width:
                    total += links[k, y - dy, x - dx] * mean[y - dy, x - dx]
            field[y, x] = total
            mean[y, x] = np.tanh(total)
    return field


@njit(cache=True, nogil=True)
def _undecided(odds: np.ndarray) -> np.ndarray:
    """Pixels (flat) within two of one whose log odds are not clipped or that differs: the others cannot change."""
    height, width = odds.shape
    out = np.empty(height * width, np.int64)
    count = 0
    for y in range(height):
        for x in range(width):
            sure = abs(odds[y, x]) >= MOST_ODDS
            for v in range(max(0, y - 2), min(height, y + 3)):
                for u in range(max(0, x - 2), min(width, x + 3)):
                    sure = sure and odds[v, u] == odds[y, x]
                if not sure:
                    break
            if not sure:
                out[count] = y * width + x
                count += 1
    return out[:count]


def _closed(mask: Bool[np.ndarray, "h w"]) -> Bool[np.ndarray, "h w"]:
    """Gaps of up to four coarse pixels closed. Where a gap is one, between locks of hair, alpha finds it again; where
    the subject has the backdrop's colour it cannot, and the mask stays whole."""
    padded = np.pad(mask, CLOSING, mode="edge")
    return eroded(dilated(padded, CLOSING), CLOSING)[CLOSING:-CLOSING, CLOSING:-CLOSING]


def _subject_only(
    mask: Bool[np.ndarray, "h w"], odds: Float32[np.ndarray, "h w"], settings: SegmentationSettings
) -> tuple[Bool[np.ndarray, "h w"], list[float]]:
    """The largest component with its small holes filled, and the areas of the others by its own."""
    count, labels, stats, _ = cv2.connectedComponentsWithStats(mask.view(np.uint8), connectivity=8)
    if count < 2:
        return np.zeros_like(mask), []
    areas = stats[1:, cv2.CC_STAT_AREA]
    main = int(np.argmax(areas)) + 1
    subject = labels == main
    others = sorted((float(a) / float(areas[main - 1]) for k, a in enumerate(areas, 1) if k != main), reverse=True)
    count, found, stats, _ = cv2.connectedComponentsWithStats((~subject).view(np.uint8), connectivity=4)
    holes = np.asarray(found, np.int32)
    size = stats[:, cv2.CC_STAT_AREA]
    # A gap between hair and shoulder shows the plate itself; clothes in its colour only nearly do. Near the outline a
    # gap among hair is crossed by strands, and must differ more before it counts as the subject.
    small = size < settings.hole_share * subject.sum()
    inner = np.bincount(holes[eroded(subject | small[holes], HAIR_DEPTH)], minlength=count) > 0.5 * size
    evidence = np.bincount(holes.ravel(), odds.ravel(), count) / size
    filled = small & ((evidence > np.where(inner, TRUE_GAP, HAIR_GAP)) | (size <= SPECK))
    filled[0] = False
    return subject | filled[holes], others


def _silhouette(
    matte: Matte,
    strangers: list[float],
    background: Background,
    settings: SegmentationSettings,
) -> Silhouette:
    alpha, holes = _without_specks(matte.alpha, settings)
    distance = distance_to_level(alpha)
    weak = float((matte.contrast < settings.weak_contrast).mean()) if len(matte.contrast) else 1.0
    contrast = float(np.median(matte.contrast)) if len(matte.contrast) else 0.0
    others = sum(a for a in strangers if a > STRANGER_SHARE)
    figures = {
        "gain": [round(float(g), 4) for g in background.gain],
        "noise_levels": round(float(np.median(background.noise)), 3),
        "background_share": round(float(background.inliers.mean()), 4),
        "weak_share": round(weak, 4),
        "other_pieces": round(others, 4),
    }
    mask = alpha > 0.5
    return Silhouette(mask, distance, _quality(mask, (1, holes), contrast, weak, figures, settings))


def _without_specks(
    alpha: Float32[np.ndarray, "h w"], settings: SegmentationSettings
) -> tuple[Float32[np.ndarray, "h w"], int]:
    """Alpha of the subject's own component without holes of noise, and how many holes are left."""
    mask = alpha > 0.5
    labels, areas = _labelled(mask, 4)
    if len(areas) > 2:
        main = int(np.argmax(areas[1:])) + 1
        alpha = np.where(mask & (labels != main), np.float32(0.49), alpha)
    labels, areas = _labelled(alpha <= 0.5, 8)
    small = areas < NOISE_HOLE
    small[0] = False
    if small.any():
        alpha = np.where(small[labels], np.float32(0.51), alpha)
    enclosed = ~np.isin(np.arange(len(areas)), np.concatenate([labels[0], labels[-1], labels[:, 0], labels[:, -1]]))
    enclosed[0] = False
    return alpha, int((enclosed & ~small).sum())


def _labelled(mask: Bool[np.ndarray, "h w"], connectivity: int) -> tuple[np.ndarray, np.ndarray]:
    """Labels of the components, 0 where the mask is False, and their areas."""
    _, labels, stats, _ = cv2.connectedComponentsWithStatsWithAlgorithm(
        mask.view(np.uint8), connectivity, cv2.CV_16U, cv2.CCL_SPAGHETTI
    )
    return labels, stats[:, cv2.CC_STAT_AREA].copy()


def _mask_quality(mask: Bool[np.ndarray, "h w"], settings: SegmentationSettings) -> ViewQuality:
    """The quality of an operator's mask."""
    components = len(_labelled(mask, 8)[1]) - 1
    holes = len(_labelled(np.pad(~mask, 1, constant_values=True), 4)[1]) - 2
    return _quality(mask, (components, holes), float("inf"), 0.0, {}, settings)


def _quality(
    mask: Bool[np.ndarray, "h w"],
    components_holes: tuple[int, int],
    contrast: float,
    weak: float,
    figures: dict,
    settings: SegmentationSettings,
) -> ViewQuality:
    """What can be said of a mask by itself."""
    borders = {"left": mask[:, 0], "right": mask[:, -1], "top": mask[0], "bottom": mask[-1]}
    cut_off = tuple(name for name, line in borders.items() if line.sum() > 2)
    warnings, fatal = [], []
    if "top" in cut_off:
        warnings.append("the head is cut off at the top of the image: move the camera back or tilt it up")
    apart = figures.get("other_pieces", 0.0)
    if apart > settings.other_pieces_warned:
        text = f"pieces of {apart:.1%} of the subject's area stand apart from it and are left out: did something move"
        text += " since the plate, or do the clothes match the backdrop?"
        (fatal if apart > settings.other_pieces_unusable else warnings).append(text)
    if weak > settings.weak_share_warned:
        text = f"{weak:.0%} of the contour hardly differs from the background: change the backdrop or the clothes"
        (fatal if weak > settings.weak_share_unusable else warnings).append(text)
    share = np.count_nonzero(mask) / mask.size
    if share < settings.least_area or share > 0.95:
        fatal.append(f"the subject covers {share:.1%} of the image, which no head does")
    gains = figures.get("gain", [1.0])
    if not all(LEAST_GAIN < g < MOST_GAIN for g in gains):
        fatal.append(f"the light differs from the plate's by a factor {max(gains):.2f}: record a new plate")
    warnings += [f"{text}; the view is left out" for text in fatal]
    components, holes = components_holes
    return ViewQuality(not fatal, contrast, cut_off, components, holes, tuple(warnings), figures)


def _nothing(shape: tuple[int, ...], background: Background) -> Silhouette:
    mask = np.zeros(shape, bool)
    text = "no subject stands out from the clean plate; the view is left out"
    figures = {"background_share": float(background.inliers.mean())}
    far = np.full(shape, float(sum(shape)), np.float32)  # no contour: farther than any pixel
    return Silhouette(mask, far, ViewQuality(False, 0.0, (), 0, 0, (text,), figures))
