"""Finds a thin swim cap or wig cap of a known colour on the head, in every photograph.

Colours are compared by chromaticity, which shading does not change. A coloured cap is compared by hue alone, because
sheen changes only saturation, and because the user may give the colour by a name. Grey caps are compared by luminance,
with a wide tolerance. The cap's colour is then measured in this capture: the median of the pixels above the brows that
resemble the given colour. Cells whose colour is nearer to that of the cheeks are labelled skin. In each view, the cap
is the largest connected set of cells, with highlights and seams filled, if most of it lies above the brows."""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass

import cv2
import numpy as np
from jaxtyping import Bool, Float, Float32, UInt8

from pipeline.part_labels.appearance_cells import DARKEST, Cells, head_guide, make_cells
from rig.mesh import Mesh
from rig.rig import Rig

CELL_MM = 1.2  # edge of a cell: three pixels of the usual rig
STATED_DEG, OWN_DEG = 32.0, 18.0  # largest hue difference from the stated colour, and from the measured one
PALEST = 0.3  # of a cap's saturation: sheen leaves no less
NEUTRAL = 0.12  # saturation (white 0, a primary 1) below which a cap has no hue; skin has 0.2 to 0.3
LIGHT_RANGE = 2.2  # log luminance of a cap without hue, in shadow and in light
ABOVE_BROWS_MM = 30.0  # where a cap covers the head, whoever wears it
MIN_SHARE = 0.35  # of the head above the brows, over all views
MIN_VIEW_SHARE = 0.2  # of the head above the brows, in one view
MIN_ABOVE = 0.4  # of a piece, above the brows: from behind, a cap reaches down to the neck
CLOSED_MM = 7.0  # highlights and seams of that width are filled


@dataclass(frozen=True, slots=True, eq=False)
class Cap:
    """Holds the pixels that show the cap, by camera, and the cap's thickness. ``share`` is the fraction of the visible
    head well above the brows that the cap covers."""

    masks: Mapping[str, Bool[np.ndarray, "_ _"]]
    thickness_mm: float
    share: float

    @property
    def is_found(self) -> bool:
        """Returns whether the cap was found in any view."""
        return bool(self.masks)


def find_cap(
    images: Mapping[str, UInt8[np.ndarray, "_ _ 3"]],
    masks: Mapping[str, Bool[np.ndarray, "_ _"]],
    rig: Rig,
    head_world: Mesh,
    face_region: Bool[np.ndarray, " v"],
    landmarks_world: Mapping[str, Float[np.ndarray, " 3"]],
    *,
    colour: Float[np.ndarray, " 3"],
    thickness_mm: float,
) -> Cap:
    """Finds the cap's pixels in every view that has a photograph and a mask.

    ``images``: sRGB photographs by camera. ``masks``: of the subject, by camera. ``rig``: the cameras as calibrated.
    ``head_world``: a head at the subject's pose, such as the mean head (mm). ``face_region``: its vertices.
    ``landmarks_world``: its landmarks (mm). ``colour``: the cap's approximate linear RGB. ``thickness_mm``: the cap's.
    """
    guide = head_guide(head_world, face_region, landmarks_world)
    used = rig.subset(name for name in rig.names if name in masks and name in images)
    cells = make_cells(images, masks, used, guide, CELL_MM)
    brows_mm = float((landmarks_world["glabella"] - guide.chin) @ guide.up)
    pieces, share = cap_cells(cells, brows_mm, colour_of(colour))
    found = {
        name: _at_pixels(piece, view.size_px, masks[name])
        for view in cells
        if (name := view.camera.name) in pieces
        for piece in [pieces[name]]
    }
    return Cap(found, thickness_mm, share)


def colour_of(linear: Float[np.ndarray, " 3"]) -> Float[np.ndarray, " 3"]:
    """Converts a linear RGB colour to the form that cells use: log red / green, log blue / green, log luminance."""
    red, green, blue = np.log(linear + DARKEST)
    return np.array([red - green, blue - green, np.log(linear @ (0.2126, 0.7152, 0.0722) + DARKEST)])


def cap_cells(
    cells: Sequence[Cells], brows_mm: float, stated: Float[np.ndarray, " 3"]
) -> tuple[dict[str, Bool[np.ndarray, "_ _"]], float]:
    """Returns the cells that show the cap, by camera, and the fraction of the head above the brows that they cover.

    Args:
        cells: the cells of each view.
        brows_mm: height of the brows above the chin.
        stated: the cap's colour, as ``colour_of`` returns it.
    """
    inside = [view.inside > 0.5 for view in cells]
    high = [shown & view.on_head & (view.above_chin_mm > brows_mm + ABOVE_BROWS_MM)
            for view, shown in zip(cells, inside, strict=True)]  # fmt: skip
    skin = _gathered(cells, [shown & (view.cheek > 0.5) for view, shown in zip(cells, inside, strict=True)])
    crown = _gathered(cells, high)
    if not len(crown) or not len(skin):
        return {}, 0.0
    cheeks = np.median(skin, axis=0)
    like = _resembles(crown, stated, cheeks, STATED_DEG)
    if like.mean() < MIN_SHARE:
        return {}, float(like.mean())
    worn = np.median(crown[like], axis=0)
    found, covered = {}, 0
    for view, shown, top in zip(cells, inside, high, strict=True):
        piece = _piece(view, shown & _resembles(view.colour, worn, cheeks, OWN_DEG), brows_mm)
        if top.any() and (piece & top).sum() >= MIN_VIEW_SHARE * top.sum():
            found[view.camera.name] = piece
            covered += int((piece & top).sum())
    share = covered / len(crown)
    return (found, share) if share >= MIN_SHARE else ({}, share)


def _gathered(cells: Sequence[Cells], chosen: Sequence[Bool[np.ndarray, "_ _"]]) -> Float32[np.ndarray, "n 3"]:
    return np.concatenate([view.colour[rows] for view, rows in zip(cells, chosen, strict=True)])


def chromaticity(colour: Float[np.ndarray, "*n 3"]) -> Float[np.ndarray, "*n 2"]:
    """Returns the chromaticity of colours: white is the origin; red, green and blue have length 1 at 0, 120 and 240
    degrees."""
    red, blue = np.exp(colour[..., 0]), np.exp(colour[..., 1])
    total = red + 1.0 + blue
    return np.stack([(red - 0.5 * (1.0 + blue)) / total, np.sqrt(0.75) * (1.0 - blue) / total], axis=-1)


def _resembles(
    colour: Float32[np.ndarray, "*n 3"], cap: Float[np.ndarray, " 3"], cheeks: Float[np.ndarray, " 3"], hue_deg: float
) -> Bool[np.ndarray, "*n"]:
    """Returns a mask of the colours that match the cap's except for shading and sheen, and are not nearer to the
    cheeks'."""
    seen, worn, skin = chromaticity(colour), chromaticity(cap), chromaticity(cheeks)
    saturation = float(np.linalg.norm(worn))
    if saturation < NEUTRAL:
        off = np.linalg.norm(seen - worn, axis=-1)
        like = (off < NEUTRAL) & (np.abs(colour[..., 2] - cap[2]) < LIGHT_RANGE)
    else:
        hue = worn / saturation
        along = seen @ hue
        off = np.linalg.norm(seen - np.maximum(along, PALEST * saturation)[..., None] * hue, axis=-1)
        like = (along > PALEST * saturation) & (off < np.tan(np.radians(hue_deg)) * along)
    return like & (off < np.linalg.norm(seen - skin, axis=-1))


def _piece(view: Cells, like: Bool[np.ndarray, "r c"], brows_mm: float) -> Bool[np.ndarray, "r c"]:
    """Returns the largest connected set of the cells that lies mostly above the brows, with its holes filled."""
    wide = max(3, 2 * round(0.5 * CLOSED_MM / CELL_MM) + 1)
    disc = cv2.getStructuringElement(cv2.MORPH_ELLIPSE, (wide, wide))
    closed = np.asarray(cv2.morphologyEx(like.astype(np.uint8), cv2.MORPH_CLOSE, disc), np.uint8)
    closed[view.inside <= 0.5] = 0
    count, labels = cv2.connectedComponents(closed, connectivity=4)
    above = view.above_chin_mm > brows_mm
    sizes, high = (np.bincount(labels.ravel(), of.ravel(), count) for of in (np.ones_like(above), above))
    sizes[0] = 0.0
    sizes[high < MIN_ABOVE * sizes] = 0.0
    if not sizes.any():
        return np.zeros_like(like)
    filled = np.zeros(like.shape, np.uint8)
    outlines = cv2.findContours((labels == sizes.argmax()).astype(np.uint8), cv2.RETR_EXTERNAL, cv2.CHAIN_APPROX_NONE)[
        0
    ]
    cv2.drawContours(filled, outlines, -1, 1, cv2.FILLED)
    return (filled > 0) & (view.inside > 0.5)


def _at_pixels(cells: Bool[np.ndarray, "r c"], size_px: int, mask: Bool[np.ndarray, "h w"]) -> Bool[np.ndarray, "h w"]:
    """Returns a mask of the subject's pixels in the cells and, up to the outline, within one cell width of them."""
    whole = np.zeros(mask.shape, np.uint8)
    grown = np.repeat(np.repeat(cells, size_px, axis=0), size_px, axis=1)
    whole[: grown.shape[0], : grown.shape[1]] = grown
    return (cv2.dilate(whole, np.ones((size_px, size_px), np.uint8)) > 0) & mask
