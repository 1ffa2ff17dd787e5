"""Measures exposure, sharpness and noise of a picture, and the motion of its background relative to a clean plate.

Brightness is in the image's values (0 to 255), lengths are in pixels. A clean plate is a picture of the empty studio.

``find_subject`` compares a picture with its clean plate at a small size, where noise averages out. This takes a few
hundredths of a second, so that the operator can shoot again while the subject is present. The outline shows whether the
subject is in the frame; reconstruction segments more precisely (``pipeline.segmentation``). The outline's intersection
over union with the true silhouettes is 0.978 to 0.987 on two rendered captures of eleven cameras.
"""

import itertools
from collections.abc import Sequence
from dataclasses import dataclass
from typing import Literal

import cv2
import numpy as np
from jaxtyping import Bool, Float

from rig.geometry import second_difference, vertex_offset
from rig.image import ImageRgb

Edge = Literal["top", "left", "right"]

WIDTH_PX = 320  # of the picture that is compared
CHANGE_LEAST = 10.0  # of 255; most shadows on a backdrop change it by less
NOISE_FACTOR = 6.0
LOOSE_PX, GAP_PX = 5, 13  # thinner parts are dropped; gaps so wide are closed (skin before a skin-coloured wall)
SHARE_LEAST = 0.02  # of the picture: a head that fills less is too far away to be measured, or nobody is there
OUTLINE_PX = 0.8  # largest error of the simplified outline
Grey = Float[np.ndarray, "h w"]

BLUR_MOST_PX = 10.0  # blur_px returns this for anything more blurred

_GAUSS_SMALL_PX, _GAUSS_LARGE_PX = 1.0, 2.0
_WORKING_WIDTH_PX = 640  # registration halves larger images until they are below twice this
_PATCH_PX = 33
_REACH_PX = 24  # largest displacement of a patch that is searched
_PATCHES_MOST = 60
_ALIKE = 0.7  # normalised correlation from which a patch counts as found
_AGREE_PX = 1.5
_PATCHES_LEAST = 5
_SCALE_MOST = 0.03  # a camera 1.2 m away would have to be moved 36 mm along its axis


@dataclass(frozen=True, slots=True)
class Exposure:
    """Holds the mean value of a picture (0 to 255) and the fraction of clipped pixels (all channels 255)."""

    mean: float
    clipped_share: float


@dataclass(frozen=True, slots=True)
class Registration:
    """Holds how well the background of a picture agrees with a clean plate.

    ``patches`` is the number of textured patches of the plate. ``found`` is the fraction of patches found in the
    picture, all moved by one similarity. ``moved_px`` is the largest motion of an image corner by this similarity, or 0
    without one. ``moved_sd_px`` is the standard deviation of ``moved_px``. ``in_place`` is the fraction of patches
    whose old position looks the same in the picture, for example on a plain wall, where patches cannot be located.
    """

    patches: int
    found: float
    moved_px: float
    moved_sd_px: float = 0.0
    in_place: float = 0.0

    @property
    def conclusive(self) -> bool:
        """Returns whether the plate has enough texture for ``found`` and ``moved_px`` to be meaningful."""
        return self.patches >= _PATCHES_LEAST


def exposure(image: ImageRgb) -> Exposure:
    """Measures the mean value of a picture and the fraction of clipped pixels."""
    red, green, blue = cv2.split(image)
    low = cv2.min(cv2.min(red, green), blue)
    return Exposure(sum(cv2.mean(image)[:3]) / 3, np.count_nonzero(low == 255) / low.size)


def noise_of(plates: Sequence[ImageRgb]) -> float | None:
    """Computes the standard deviation of the temporal noise from pictures of a static scene; None for one picture.

    The difference of successive pictures has the variance 2 sigma^2. The variance is computed within blocks of 16 px,
    where drifting light hardly matters. The median over all blocks ignores motion in a few blocks.
    """
    variances = [_block_variance(after, before) for before, after in itertools.pairwise(plates)]
    return float(np.sqrt(np.median(variances) / 2)) if variances else None


def disturbed(plates: Sequence[ImageRgb], noise: float) -> bool:
    """Returns whether a block of 16 px changed between clean plates by more than 8 standard deviations."""
    first = cv2.resize(plates[0].astype(np.float32), None, fx=1 / 16, fy=1 / 16, interpolation=cv2.INTER_AREA)
    # A block's mean has 1/16 of the noise. No person changes it by less than 4.
    limit = max(8.0 * noise * np.sqrt(2) / 16, 4.0)
    for plate in plates[1:]:
        small = cv2.resize(plate.astype(np.float32), None, fx=1 / 16, fy=1 / 16, interpolation=cv2.INTER_AREA)
        change = small - first
        if np.abs(change - np.median(change, axis=(0, 1))).max() > limit:
            return True
    return False


def blur_px(image: ImageRgb) -> float | None:
    """Measures the blur of a picture as the standard deviation (px) of a Gaussian that would blur a sharp edge as much.
    Returns None if the picture has no edges.

    A step of height A, blurred with standard deviation s, has the gradient energy A^2 / (2 sqrt(pi) s) across it.
    Blurring the picture further, by known s1 and by s2, gives energies with the ratio q = sqrt((s^2 + s2^2) / (s^2 +
    s1^2)), which is the same for every height A and is solved for s. Only pixels with the strongest gradients are used,
    because they lie on steps. The energy of the noise, measured in other pixels, is subtracted first.
    """
    grey = np.asarray(cv2.cvtColor(image, cv2.COLOR_RGB2GRAY), np.float32)
    small, large = _gradient_energy(grey, _GAUSS_SMALL_PX), _gradient_energy(grey, _GAUSS_LARGE_PX)
    edges = large > np.quantile(large[::4, ::4], 0.98)
    edges = cv2.dilate(edges.astype(np.uint8), np.ones((9, 9), np.uint8)) > 0  # the whole profile of the step
    if edges.all() or not edges.any():
        return None
    floor_small, floor_large = (float(np.median(energy[~edges])) for energy in (small, large))
    top, bottom = float(small[edges].mean()) - floor_small, float(large[edges].mean()) - floor_large
    if bottom <= 0 or float(large[edges].mean()) < 4 * floor_large:
        return None
    ratio2 = (top / bottom) ** 2
    if ratio2 <= 1:
        return BLUR_MOST_PX  # wider than the two blurs can tell apart
    # the central difference blurs like a box of 2 px, whose variance is 1/3
    squared = (_GAUSS_LARGE_PX**2 - ratio2 * _GAUSS_SMALL_PX**2) / (ratio2 - 1) - 1 / 3
    return float(min(np.sqrt(max(squared, 0.0)), BLUR_MOST_PX))


def register(image: ImageRgb, plate: ImageRgb) -> Registration:
    """Measures the background's motion from ``plate`` to ``image``, where a subject may hide parts of the background.

    Normalised correlation, which does not depend on brightness and contrast, searches the picture for textured patches
    of the clean plate near their old positions. RANSAC finds the similarity transform that explains the motions of most
    patches; ``found`` counts these patches.
    """
    if image.shape != plate.shape:
        return Registration(_PATCHES_MOST, 0.0, 0.0)
    factor = 1.0
    while image.shape[1] * factor >= 2 * _WORKING_WIDTH_PX:
        factor /= 2
    here, there = _working(plate, factor), _working(image, factor)
    points = _textured_points(here)
    moved = [(point, shifted) for point in points if (shifted := _find(here, there, point)) is not None]
    in_place = sum(_is_alike(here, there, point) for point in points) / max(len(points), 1)
    nothing = Registration(len(points), 0.0, 0.0, in_place=in_place)
    if len(points) < _PATCHES_LEAST or len(moved) < 3:
        return nothing
    source, target = (np.asarray(side, np.float64) for side in zip(*moved, strict=True))
    similarity, agree = cv2.estimateAffinePartial2D(source, target, ransacReprojThreshold=_AGREE_PX, maxIters=500)
    if similarity is None or agree is None or int(agree.sum()) < 3:
        return nothing
    moved_px = _largest_move(similarity, here.shape)
    if abs(np.hypot(similarity[0, 0], similarity[1, 0]) - 1) > _SCALE_MOST or moved_px > 2 * _REACH_PX:
        return nothing  # no camera can move like this: the patches agree by chance
    matched = agree.ravel() > 0
    moved_sd_px = _corner_deviation(similarity, source[matched], target[matched], here.shape)
    matched_share = float(matched.sum()) / len(points)
    return Registration(len(points), matched_share, moved_px / factor, moved_sd_px / factor, in_place)


def _block_variance(after: ImageRgb, before: ImageRgb) -> float:
    """Returns the median variance of the difference of two pictures over all blocks of 16 px and all channels."""
    size = 16 if min(after.shape[:2]) >= 16 else 1
    height, width = (length // size * size for length in after.shape[:2])
    difference = after[:height, :width].astype(np.float32) - before[:height, :width]
    blocks = difference.reshape(height // size, size, width // size, size, 3)
    return float(np.median(blocks.var(axis=(1, 3), ddof=1 if size > 1 else 0)))


def _gradient_energy(grey: Grey, sigma_px: float) -> Grey:
    smooth = cv2.GaussianBlur(grey, (0, 0), sigma_px)
    dx = cv2.filter2D(smooth, cv2.CV_32F, np.array([[-0.5, 0, 0.5]], np.float32))
    dy = cv2.filter2D(smooth, cv2.CV_32F, np.array([[-0.5], [0], [0.5]], np.float32))
    return dx * dx + dy * dy


def _working(image: ImageRgb, factor: float) -> Grey:
    grey = np.asarray(cv2.cvtColor(image, cv2.COLOR_RGB2GRAY))
    if factor < 1:
        grey = cv2.resize(grey, None, fx=factor, fy=factor, interpolation=cv2.INTER_AREA)
    return np.asarray(cv2.GaussianBlur(grey.astype(np.float32), (0, 0), 1.5), np.float32)


def _textured_points(grey: Grey) -> list[tuple[int, int]]:
    margin = _PATCH_PX // 2 + _REACH_PX + 1
    if min(grey.shape) <= 2 * margin:
        return []
    inside = np.zeros(grey.shape, np.uint8)
    inside[margin:-margin, margin:-margin] = 1
    corners = cv2.goodFeaturesToTrack(
        grey, _PATCHES_MOST, qualityLevel=0.02, minDistance=_PATCH_PX * 0.7, mask=inside, blockSize=9
    )
    return [] if corners is None else [(round(float(x)), round(float(y))) for x, y in corners.reshape(-1, 2)]


def _find(here: Grey, there: Grey, point: tuple[int, int]) -> tuple[float, float] | None:
    x, y = point
    half, reach = _PATCH_PX // 2, _PATCH_PX // 2 + _REACH_PX
    patch = here[y - half : y + half + 1, x - half : x + half + 1]
    window = there[y - reach : y + reach + 1, x - reach : x + reach + 1]
    ncc_score = cv2.matchTemplate(window, patch, cv2.TM_CCOEFF_NORMED)
    _, best, _, (column, row) = cv2.minMaxLoc(ncc_score)
    if best < _ALIKE:
        return None
    return (
        x + column - _REACH_PX + _peak(ncc_score[row, :], column),
        y + row - _REACH_PX + _peak(ncc_score[:, column], row),
    )


def _is_alike(here: Grey, there: Grey, point: tuple[int, int]) -> bool:
    (x, y), half = point, _PATCH_PX // 2
    window = slice(y - half, y + half + 1), slice(x - half, x + half + 1)
    return bool(cv2.matchTemplate(there[window], here[window], cv2.TM_CCOEFF_NORMED)[0, 0] >= _ALIKE)


def _peak(values: Float[np.ndarray, " n"], at: int) -> float:
    """Returns the sub-sample offset of a peak from its highest value, at index ``at``; 0 at the ends of ``values``."""
    if not 0 < at < len(values) - 1:
        return 0.0
    left, middle, right = (float(values[at + step]) for step in (-1, 0, 1))
    curvature = second_difference(left, middle, right)
    return 0.0 if curvature >= 0 else max(-0.5, min(0.5, vertex_offset(left, right, curvature)))


def _corners(shape: tuple[int, ...]) -> Float[np.ndarray, "4 2"]:
    height, width = shape[:2]
    return np.array([(0, 0), (width - 1, 0), (0, height - 1), (width - 1, height - 1)], float)


def _corner_deviation(
    similarity: Float[np.ndarray, "2 3"],
    source: Float[np.ndarray, "n 2"],
    target: Float[np.ndarray, "n 2"],
    shape: tuple[int, ...],
) -> float:
    """Returns the largest standard deviation (px), over the image corners, of a similarity fitted to points.

    In complex numbers, a similarity transform multiplies ``x - mean`` by a factor and adds a shift. The similarity's
    factor has the variance sigma^2 over the sum of |x - mean|^2, and its shift has the variance sigma^2 / n.
    """
    residuals = target - source @ similarity[:, :2].T - similarity[:, 2]
    variance = float((residuals**2).sum()) / (2 * len(source) - 4)  # per coordinate, four parameters
    centre = source.mean(axis=0)
    spread2 = float(((source - centre) ** 2).sum())
    reach2 = float(((_corners(shape) - centre) ** 2).sum(axis=1).max())
    return float(np.sqrt(2 * variance * (1 / len(source) + reach2 / spread2)))


def _largest_move(similarity: Float[np.ndarray, "2 3"], shape: tuple[int, ...]) -> float:
    corners = _corners(shape)
    moved = corners @ similarity[:, :2].T + similarity[:, 2]
    return float(np.linalg.norm(moved - corners, axis=1).max())


@dataclass(frozen=True, slots=True)
class SubjectPlace:
    """Holds the position of the subject in a picture.

    ``outline`` holds the corners of its contour (px). ``share`` is the fraction of the picture that it fills.
    ``cut_off`` lists the picture's edges that touch the outline's upper half; the bottom edge always cuts a bust.
    """

    outline: tuple[tuple[float, float], ...]
    share: float
    cut_off: tuple[Edge, ...]


def find_subject(image: ImageRgb, plate: ImageRgb) -> SubjectPlace | None:
    """Finds the subject as the largest region of a picture that differs from the clean plate. Returns None if no region
    as large as a head differs."""
    if image.shape != plate.shape:
        return None
    here, there = (np.float32(_reduced(picture)) + 1.0 for picture in (image, plate))
    gain = np.median(here / there, axis=(0, 1))  # the light may be brighter or dimmer than for the plate
    change = np.abs(here - gain * there).max(axis=2)
    noise = 1.4826 * float(np.median(change))
    return _place(change > max(CHANGE_LEAST, NOISE_FACTOR * noise), image.shape)


def subject_of_mask(mask: Bool[np.ndarray, "h w"]) -> SubjectPlace | None:
    """Returns the subject's position in a picture with a known mask; None if it has no region as large as a head."""
    return _place(_reduced(mask.astype(np.uint8)) > 0, mask.shape)


def _reduced(picture: np.ndarray) -> np.ndarray:
    height, width = picture.shape[:2]
    factor = min(1.0, WIDTH_PX / width)
    return cv2.resize(picture, (round(width * factor), max(1, round(height * factor))), interpolation=cv2.INTER_AREA)


def _place(different: Bool[np.ndarray, "h w"], shape: tuple[int, ...]) -> SubjectPlace | None:
    opened = cv2.morphologyEx(different.astype(np.uint8), cv2.MORPH_OPEN, np.ones((LOOSE_PX, LOOSE_PX), np.uint8))
    disc = cv2.getStructuringElement(cv2.MORPH_ELLIPSE, (GAP_PX, GAP_PX))
    contours, _ = cv2.findContours(
        cv2.morphologyEx(opened, cv2.MORPH_CLOSE, disc), cv2.RETR_EXTERNAL, cv2.CHAIN_APPROX_NONE
    )
    largest = max(contours, key=cv2.contourArea, default=None)
    if largest is None:
        return None
    filled = cv2.drawContours(np.zeros(different.shape, np.uint8), [largest], -1, 1, cv2.FILLED) > 0
    share = float(filled.mean())
    if share < SHARE_LEAST:
        return None
    scale = shape[1] / different.shape[1]
    corners = cv2.approxPolyDP(largest, OUTLINE_PX, True).reshape(-1, 2)
    outline = tuple((float((x + 0.5) * scale - 0.5), float((y + 0.5) * scale - 0.5)) for x, y in corners)
    return SubjectPlace(outline, share, _cut_off(filled))


def _cut_off(filled: Bool[np.ndarray, "h w"]) -> tuple[Edge, ...]:
    rows = np.flatnonzero(filled.any(axis=1))
    head = filled[: (int(rows[0]) + int(rows[-1])) // 2 + 1]
    edges: tuple[tuple[Edge, np.ndarray], ...] = (("top", head[0]), ("left", head[:, 0]), ("right", head[:, -1]))
    return tuple(edge for edge, line in edges if line.any())
