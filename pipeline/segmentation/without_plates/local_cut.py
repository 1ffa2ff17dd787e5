"""Finds the edge itself from a coarse mask, which may be a hand's breadth too wide where the surroundings look similar.

Windows along the outline are cut one by one (Rother et al., *GrabCut*, SIGGRAPH 2004, in OpenCV), so that colours are
local, and overlapping windows are averaged (Bai et al., *Video SnapCut*, 2009). Then the views are compared again: what
is left of the surroundings in one is rejected by another view's edge.
"""

from collections.abc import Callable, Mapping
from dataclasses import dataclass

import cv2
import numpy as np
from jaxtyping import Bool, Float32, UInt8

from pipeline.compute.threads import task_pool
from pipeline.imaging.masks import dilated, eroded
from pipeline.segmentation.mean_field_kernels import MAX_ODDS
from pipeline.segmentation.without_plates.viewing_volume import ViewingVolume, ask_other_views

Mask = Bool[np.ndarray, "h w"]

COLUMNS = 640  # of the images that are cut: 2 px of a picture of 1300
WINDOW, STEP = 80, 28  # px of them: side of a window, and from one to the next along the outline
ITERATIONS = 2
DENIED = -6.0  # sum of log odds below which the other views leave nothing of the subject: two of them deny it
MIN_SAMPLES = 30  # pixels of each kind that a window must be sure of
MIN_PIECE = 100  # px of outline


@dataclass(frozen=True, slots=True)
class Bands:
    """Holds how far inside and outside the given outline the edge is searched, in pixels of the images that are cut."""

    inside: int
    outside: int


BANDS = (Bands(14, 8), Bands(8, 6))
"""Of the first cut, whose masks are of the coarse level, and of the second."""


def cut_along(image: UInt8[np.ndarray, "h w 3"], mask: Mask, bands: Bands) -> Float32[np.ndarray, "h w"]:
    """Cuts the image in windows along the mask's outline. Returns, for each pixel, the share of the windows over it
    that assign it to the subject, weighted towards their middles."""
    height, width = mask.shape
    inner, outer = eroded(mask, bands.inside), ~dilated(mask, bands.outside)
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
    """Cuts one window into subject and background; None if too few of its pixels are sure on either side."""
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
    """Returns the subject's share of each pixel in every view, at the size of ``images``. ``volume`` belongs to the
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
    """Returns the cut masks without the pixels that the cuts of the other views rule out."""
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
