"""Interprets the values of mask files as the subject's share in every pixel.

Programs write masks as 0 and 1, 0 and 255, 16 bits, two colours, an alpha channel, soft greys, and as JPEG, whose
ringing leaves values of 1 to 40 ten pixels outside an outline. All masks have two values that fill areas, and the
outline lies at the mean of both values. The values are measured over all masks of a capture, so that noise in an empty
mask is no subject. Mask files with labels, depth or a photograph are faults.

In masks the subject is white by this project's convention, but black in programs that mark the pixels to ignore. Two
criteria decide which of a mask's values is the subject: the background covers all borders but one, which shows the
shoulders, and the subject covers the middle. A mask is inverted if both criteria say that the subject is black. The two
criteria disagree for a close-up that fills the frame and for a subject beside the middle. Masks that the criteria leave
undecided are treated as most other masks of the capture.
"""

from collections.abc import Mapping
from dataclasses import dataclass
from typing import Literal

import cv2
import numpy as np
from jaxtyping import Bool, Float, Num, UInt8

from rig.messages.message import Message, compose

Convention = Literal["white", "black"]

BORDER_MARGIN = 0.15  # of the borders' length, by which one convention must fit better: shoulders leave 0.25 and more
MIDDLE_RADIUS = 0.06  # of the picture's longer side: half a face
MIDDLE_MARGIN = 0.3  # by which the share of white in the middle must differ from one half
Pixels = Num[np.ndarray, "h w *channels"]
Plane = Num[np.ndarray, "h w"]
Share = UInt8[np.ndarray, "h w"]

BINS = 256  # of the histogram over the range that the masks use
PLATEAU_SHARE = 0.005  # of the picture, from which a value fills an area; one of a soft edge 40 px wide has 0.0006
AREA_WITHIN = 0.2  # share of an area's pixels whose 8 neighbours are of it too: 0 on soft edges, 0.4 in a band of 5 px
PLATEAU_APART = 0.1  # of the range: nearer values are one plateau; ringing of JPEG 50 to 98 scatters by 0.08
NEAR_LEVEL = 0.03  # of the range, to both sides of a level
AREAS_LEAST = 0.7  # of a picture that its levels must hold: 0.85 with soft edges of 40 px, 0.2 of a smooth ramp
BETWEEN = (0.15, 0.85)  # of the range: neither subject nor background
BETWEEN_MOST = 0.35  # pixels between, relative to the smaller area: 0.15 with a soft edge of 20 px, 0.9 in a depth map
SOFT_PER_PX = 0.35  # pixels between by the outline's length: 0.9 where edges were averaged, 0.0 to 0.2 in JPEG 50 to 98
BAND_MOST_PX = 24.0  # half width of a band that a trimap leaves undecided
FAINT = 0.25  # of the capture's range: a file with a smaller range and more than two values shows only noise
LABELS_MOST = 32  # values that are counted one by one: finer than JPEG leaves them
COLOURS_TWO = 0.95  # share of a picture that its two most frequent colours hold
COLOURS_FEW = 64  # a picture of labels has at most so many colours, a photograph thousands
CUT_OUT_LEAST = 0.1  # share of a picture that a cut-out leaves in exactly one colour
VALUES_NAMED = 6


@dataclass(frozen=True, slots=True, eq=False)
class MaskReading:
    """Holds a mask and its interpretation.

    ``share`` is the subject's share in each pixel, 0 to 255. ``soft`` is True if edges are soft, so that grey values
    locate the outline within a pixel. ``fault`` is the reason why the file is no valid mask, for which ``share`` is 0.
    ``remark`` is a warning."""

    share: Share
    soft: bool = False
    fault: Message | None = None
    remark: Message | None = None


def mask_plane(pixels: Pixels) -> Plane | Message:
    """Returns the channel of decoded pixels (BGR order) that contains the mask, or a fault if there is none.

    The mask is the alpha channel if its values vary. In a picture of two colours, the mask is the channel in which the
    colours differ most. If a photograph of the subject has a background of exactly one colour, the result is 0 at this
    colour and 1 elsewhere."""
    channels = pixels[:, :, None] if pixels.ndim == 2 else pixels
    if channels.shape[2] in (2, 4):
        alpha = channels[:, :, -1]
        if alpha.min() < alpha.max():
            return np.ascontiguousarray(alpha)
        channels = channels[:, :, :-1]
    if channels.shape[2] == 1 or all(np.array_equal(channels[:, :, 0], channels[:, :, k]) for k in (1, 2)):
        return np.ascontiguousarray(channels[:, :, 0])
    return _plane_of_colours(channels)


def _plane_of_colours(channels: Num[np.ndarray, "h w c"]) -> Plane | Message:
    span = max(float(channels.max()), 1.0)
    coarse = (channels.astype(np.float32) * (15.0 / span) + 0.5).astype(np.int32)
    codes, counts = np.unique(coarse @ (1, 16, 256), return_counts=True)
    order = np.argsort(counts)[::-1]
    if len(order) == 1 or counts[order[:2]].sum() >= COLOURS_TWO * counts.sum():
        pair = np.array([[code % 16, code // 16 % 16, code // 256] for code in codes[order[:2]].tolist()])
        return np.ascontiguousarray(channels[:, :, int(np.argmax(np.ptp(pair, axis=0)))])
    packed = channels.reshape(-1, channels.shape[2]).astype(np.float64) @ (1.0, 2.0**16, 2.0**32)
    exact, numbers = np.unique(packed, return_counts=True)
    if len(exact) <= COLOURS_FEW:
        return compose("mask-of-colours", count=len(exact))
    if numbers.max() >= CUT_OUT_LEAST * packed.size:
        return (packed != exact[np.argmax(numbers)]).reshape(channels.shape[:2]).astype(np.uint8)
    return compose("mask-is-photograph")


def read_masks(planes: Mapping[str, Plane]) -> dict[str, MaskReading]:
    """Interprets the masks of one capture. All files with the same data type together determine the range of values."""
    ranges: dict[str, tuple[float, float]] = {}
    for plane in planes.values():
        low, high = _range(plane)
        before = ranges.get(str(plane.dtype), (low, high))
        ranges[str(plane.dtype)] = (min(before[0], low), max(before[1], high))
    return {name: _read(plane, ranges[str(plane.dtype)]) for name, plane in planes.items()}


def _range(plane: Plane) -> tuple[float, float]:
    finite = plane[np.isfinite(plane)] if plane.dtype.kind == "f" else plane
    return (float(finite.min()), float(finite.max())) if finite.size else (0.0, 0.0)


def _read(plane: Plane, common: tuple[float, float]) -> MaskReading:
    low, high = _range(plane)
    faint = high - low < FAINT * (common[1] - common[0]) and len(np.unique(plane)) > 2
    if low == high or faint:
        return MaskReading(_nothing(plane), fault=_constant_fault(low, common))
    levels = _levels(plane, (low, high))
    if not _fills_areas(plane, levels, high - low):
        return MaskReading(_nothing(plane), fault=compose("mask-spread"))
    if len(levels) > 2:
        return _read_trimap(plane, levels)
    share = _share_between(plane, levels[0], levels[1])
    between = np.count_nonzero((share > 255 * BETWEEN[0]) & (share < 255 * BETWEEN[1]))
    white = share > 127
    smaller = min(np.count_nonzero(white), np.count_nonzero(~white))
    if between > BETWEEN_MOST * max(smaller, 1):
        return MaskReading(_nothing(plane), fault=compose("mask-spread"))
    beside = white & (cv2.erode(white.astype(np.uint8), np.ones((3, 3), np.uint8)) == 0)  # a pixel of background
    return MaskReading(share, soft=bool(between > SOFT_PER_PX * max(np.count_nonzero(beside), 1)))


def _nothing(plane: Plane) -> Share:
    return np.zeros(plane.shape, np.uint8)


def _constant_fault(value: float, common: tuple[float, float]) -> Message:
    if value == 0 or value < 0.5 * (common[0] + common[1]):
        return compose("mask-empty")
    return compose("mask-constant", value=value)


def _levels(plane: Plane, span: tuple[float, float]) -> list[float]:
    """Returns the values that fill areas, in ascending order. Of close mask values, returns the most frequent."""
    low, high = span
    exact = plane.dtype.kind in "ui" and high - low < BINS
    count = int(high - low) + 1 if exact else BINS
    step = (high - low) / (count - 1)
    finite = np.nan_to_num(plane.astype(np.float64), nan=low, posinf=high, neginf=low)
    at = np.rint((finite - low) / step).astype(int)
    numbers = np.bincount(at.ravel(), minlength=count)
    apart = 0 if exact and count <= LABELS_MOST else PLATEAU_APART * count
    plateaus: list[int] = []
    for number in np.argsort(numbers)[::-1].tolist():
        if numbers[number] < PLATEAU_SHARE * plane.size:
            break
        if all(abs(number - other) > apart for other in plateaus) and _is_area(
            np.abs(at - number) <= NEAR_LEVEL * count
        ):
            plateaus.append(number)
    return sorted(low + step * number for number in plateaus)


def _is_area(pixels: Bool[np.ndarray, "h w"]) -> bool:
    """Returns whether most True pixels have only True neighbours, unlike those of one grey level in a soft edge."""
    within = cv2.erode(pixels.astype(np.uint8), np.ones((3, 3), np.uint8))
    return bool(np.count_nonzero(within) > AREA_WITHIN * np.count_nonzero(pixels))


def _fills_areas(plane: Plane, levels: list[float], span: float) -> bool:
    """Returns whether there are at least two levels, and most pixels have one of them."""
    near = sum(np.count_nonzero(np.abs(plane.astype(np.float64) - level) <= NEAR_LEVEL * span) for level in levels)
    return len(levels) > 1 and bool(near >= AREAS_LEAST * plane.size)


def _share_between(plane: Plane, black: float, white: float) -> Share:
    share = np.nan_to_num((plane.astype(np.float32) - np.float32(black)) / np.float32(white - black))
    return (255.0 * np.clip(share, 0.0, 1.0) + 0.5).astype(np.uint8)


def _read_trimap(plane: Plane, levels: list[float]) -> MaskReading:
    """Reads a trimap. A mask's outline becomes the middle of the band of undecided pixels, which must be narrow and lie
    between black and white."""
    named = [f"{level:g}" for level in levels[:VALUES_NAMED]] + ["..."] * (len(levels) > VALUES_NAMED)
    labels = compose("mask-of-labels", count=len(levels), values=named)
    if len(levels) > 3:
        return MaskReading(_nothing(plane), fault=labels)
    share = _share_between(plane, levels[0], levels[2])
    black, white = share < 64, share > 191
    away_black, away_white = (
        np.asarray(cv2.distanceTransform((~area).astype(np.uint8), cv2.DIST_L2, cv2.DIST_MASK_PRECISE))
        for area in (black, white)
    )
    width = float(np.minimum(away_black, away_white)[~black & ~white].max(initial=0.0))
    touching = cv2.dilate(white.astype(np.uint8), np.ones((3, 3), np.uint8)).view(bool) & black
    if width > BAND_MOST_PX or touching.mean() > 1e-4:
        return MaskReading(_nothing(plane), fault=labels)
    middle = away_black / np.maximum(away_black + away_white, np.float32(1e-3))
    remark = compose("mask-band", width_px=2 * width)
    return MaskReading((255.0 * middle + 0.5).astype(np.uint8), soft=True, remark=remark)


def subject_convention(
    mask: Bool[np.ndarray, "h w"], middle_px: Float[np.ndarray, " 2"] | None = None
) -> Convention | None:
    """Returns whether the subject is white or black according to this mask alone, or None if the criteria disagree.

    Args:
        mask: True where it is white.
        middle_px: pixel of the point at which the cameras look; by default the middle of the picture.
    """
    sides = np.sort([mask[0].mean(), mask[-1].mean(), mask[:, 0].mean(), mask[:, -1].mean()])
    white_at_borders, black_at_borders = float(sides[:3].mean()), float(1.0 - sides[1:].mean())
    height, width = mask.shape
    x, y = ((width - 1) / 2, (height - 1) / 2) if middle_px is None else middle_px
    reach = max(1, round(MIDDLE_RADIUS * max(width, height)))
    column, row = int(np.clip(x, 0, width - 1)), int(np.clip(y, 0, height - 1))
    about = mask[max(0, row - reach) : row + reach + 1, max(0, column - reach) : column + reach + 1]
    inside = float(about.mean()) - 0.5
    if white_at_borders + BORDER_MARGIN < black_at_borders and inside > MIDDLE_MARGIN:
        return "white"
    if black_at_borders + BORDER_MARGIN < white_at_borders and inside < -MIDDLE_MARGIN:
        return "black"
    return None


def inverted_masks(
    masks: Mapping[str, Bool[np.ndarray, "_ _"]], middles_px: Mapping[str, Float[np.ndarray, " 2"]]
) -> list[str]:
    """Returns the names of the masks whose subject is black. An undecided mask is interpreted as most other masks are.

    Args:
        masks: by camera, True where they are white.
        middles_px: by camera, the pixel of the point at which all cameras look.
    """
    said = {name: subject_convention(mask, middles_px.get(name)) for name, mask in masks.items()}
    black = [name for name, convention in said.items() if convention == "black"]
    white = [name for name, convention in said.items() if convention == "white"]
    follow = len(black) > len(white)
    return [name for name, convention in said.items() if convention == "black" or (convention is None and follow)]
