"""Labels every pixel of the subject as skin, hair or clothes, with models learnt from the same capture.

The labelling starts from positions: the middle of the fitted face is skin. Pixels beside the head and above the chin
are hair, unless they resemble the face's skin (a bald crown). Pixels below the chin are clothes, unless they resemble
the face's skin. Expectation maximisation (Dempster, Laird and Rubin 1977) then learns the appearance of each label in
this capture: histograms of colour and fine structure over all views, with the cameras' colours balanced. A label's
prior probability depends on the position on the head. A filter that preserves edges of the photograph smooths the
probabilities (He, Sun and Tang 2010, guided image filtering, https://doi.org/10.1007/978-3-642-15549-9_1). A cap is
labelled as clothes if it resembles the clothes, and as hair otherwise; both hide skin."""

from collections.abc import Mapping
from dataclasses import dataclass

import cv2
import numpy as np
from jaxtyping import Bool, Float, Float32, Int, UInt8

from pipeline.compute.threads import map_in_threads
from pipeline.imaging.silhouette import Silhouette
from pipeline.part_labels.appearance_cells import Cells, head_guide, make_cells
from pipeline.part_labels.codes import CHANNELS, Part
from pipeline.part_labels.label_kernels import spread_parts
from rig.mesh import Mesh
from rig.progress import Progress
from rig.rig import Rig

CELL_MM = 2.2  # side of a cell of the grid that is labelled: four pixels of the usual rig
STEPS = 4  # of expectation and maximisation
STRENGTH = 0.7  # weight of a cell's appearance: colour and structure of neighbours are not independent
SMOOTH_MM = 9.0  # window over which neighbours agree
EDGE = 0.05  # contrast (0 to 1, as displayed) that ends such a window
SKIN_CHANNEL, HAIR_CHANNEL, CLOTHES_CHANNEL = (part.channel for part in CHANNELS)

RED_BINS, BLUE_BINS, LIGHT_BINS, DETAIL_BINS = 36, 40, 20, 20
RED_RANGE, BLUE_RANGE = (-0.8, 1.4), (-1.4, 1.0)  # of log ratios to green
LIGHT_RANGE, DETAIL_RANGE = (-4.7, 0.4), (-4.7, -0.9)
CHROMA_BLUR, LIGHT_BLUR, DETAIL_BLUR = 0.9, 1.6, 1.2  # bins; light falls off within each part
SHADE_SHARE, SHADE_BLUR = 0.4, 4.0  # of a part's looks: its colours in light that only others of them have; bins
OUTLIER = 0.02  # share of what belongs to no part
BARE_PRIOR, BEARD_PRIOR = (0.8, 0.17), (0.3, 0.67)  # of skin and hair on a lower face without a beard, and with one
BEARD_SHARE = (0.2, 0.45)  # share of the lower face that differs from the cheeks: no beard, certain beard
CONFIDENT = 0.8  # only cells this probable train their label: others would make all labels alike
MIN_PRESENT = 1e-3  # share of cells certain by position that differ from skin: a bald head has no hair
SKIN_RATIO = 0.15  # ratio of frequencies (skin to subject) at which an appearance is half skin
OUTLIER_BINS = RED_BINS * BLUE_BINS * LIGHT_BINS * DETAIL_BINS / 50.0  # that a part of its own would fill evenly
PLAIN = 0.1  # a cell that is less of a feature or underside than this is plain skin, or a beard
FLOOR = 0.02  # probability of appearances that a label's histogram lacks


@dataclass(frozen=True, slots=True, eq=False)
class PartMap:
    """Holds one view's probabilities of skin, hair and clothes at each pixel of the photograph, in 255ths: one byte
    each, because a view has millions of pixels. The sum is at most 255, and the remainder is unknown; outside the
    subject all probabilities are 0."""

    camera: str
    of_255: UInt8[np.ndarray, "h w 3"]

    @property
    def probability(self) -> Float32[np.ndarray, "h w 3"]:
        """Returns the probabilities of skin, hair and clothes, 0 to 1."""
        return self.of_255 * np.float32(1 / 255)

    def probability_of(self, part: Part) -> Float32[np.ndarray, "h w"]:
        """Returns the probability of one label at every pixel."""
        return self.of_255[..., part.channel] * np.float32(1 / 255)

    def with_clothes(self, mask: Bool[np.ndarray, "h w"]) -> "PartMap":
        """Returns the map with the probability of clothes set to 1 where ``mask`` is true."""
        clothes = np.zeros(3, np.uint8)
        clothes[CLOTHES_CHANNEL] = 255
        return PartMap(self.camera, np.where(mask[..., None], clothes, self.of_255))


def classify_parts(
    images: Mapping[str, UInt8[np.ndarray, "h w 3"]],
    silhouettes: Mapping[str, Silhouette],
    rig: Rig,
    head_world: Mesh,
    face_region: Bool[np.ndarray, " v"],
    landmarks_world: Mapping[str, Float[np.ndarray, " 3"]],
    *,
    report: Progress,
) -> dict[str, PartMap]:
    """Computes, for every usable view with a photograph, the probability that each pixel shows skin, hair or clothes.

    Args:
        images: sRGB photographs by camera.
        silhouettes: silhouettes of the subject, by camera; unusable views are left out.
        rig: the cameras as calibrated.
        head_world: the fitted head without hair (mm).
        face_region: its vertices from ear to ear and from the lower forehead to under the chin.
        landmarks_world: its 26 landmarks (mm).
        report: progress.

    Returns:
        A map for each usable view with a photograph.
    """
    masks = {n: s.mask for n, s in silhouettes.items() if s.quality.usable and n in images and n in rig.names}
    used = rig.subset(name for name in rig.names if name in masks)
    report("parts", 0.0)
    head = head_guide(head_world, face_region, landmarks_world)
    cells = make_cells(images, masks, used, head, CELL_MM)
    if not cells:
        return {}
    inside = [view.inside > 0.5 for view in cells]

    def gathered(maps: list[np.ndarray]) -> np.ndarray:
        return np.concatenate([each[mask] for each, mask in zip(maps, inside, strict=True)])

    appearance = gathered([bins(view) for view in cells])
    start = gathered([starts(view) for view in cells])
    # Evenly lit skin of a face without a beard: no lips, and no underside of jaw and chin, which is always dark.
    lower = gathered([beard_zone(view) & (np.maximum(view.feature, view.underside) < PLAIN) for view in cells])
    by_colour, by_both = unlike_cheeks(appearance, start[:, SKIN_CHANNEL])
    bearded = beard_evidence(by_both, lower)
    unlikeness = by_colour + bearded * lower * (by_both - by_colour)
    place = gathered([place_prior(view, bearded) for view in cells])
    report("parts", 0.4)
    share = posterior(fit_appearance(appearance, place, start, lower, unlikeness), place)
    report("parts", 0.6)
    rows = np.split(share, np.cumsum([np.count_nonzero(mask) for mask in inside])[:-1])

    def one(k: int) -> PartMap:
        name = cells[k].camera.name
        return PartMap(name, upsample_guided(cells[k], inside[k], rows[k], images[name], masks[name]))

    found = map_in_threads(one, len(cells))
    report("parts", 1.0)
    return {each.camera: each for each in found}


def bins(view: Cells) -> Int[np.ndarray, "r c 2"]:
    """Returns two histogram bins for every cell: one for its colour, and one for its fine structure."""
    red, blue, light = np.moveaxis(view.colour, 2, 0)
    a, b = _bin(red, RED_RANGE, RED_BINS), _bin(blue, BLUE_RANGE, BLUE_BINS)
    colour = (a * BLUE_BINS + b) * LIGHT_BINS + _bin(light, LIGHT_RANGE, LIGHT_BINS)
    return np.stack([colour, _bin(view.detail, DETAIL_RANGE, DETAIL_BINS)], axis=-1)


def _bin(values: Float32[np.ndarray, "r c"], span: tuple[float, float], count: int) -> Int[np.ndarray, "r c"]:
    return np.clip(((values - span[0]) * (count / (span[1] - span[0]))).astype(np.int64), 0, count - 1)


def starts(view: Cells) -> Float32[np.ndarray, "r c 3"]:
    """Returns masks (1 or 0) of the cells that are almost certainly skin, hair or clothes because of their position,
    one channel for each label.

    Cheeks and nose count as skin. The cranium far from the face counts as hair, and so do cells beside the head above
    the ears. Cells well below the chin and beside the neck count as clothes."""
    skin = view.cheek > 0.5
    beside = ~view.on_head & (view.outside_mm > 3.0)
    hair = (beside | (view.into_face_mm < -45.0)) & (view.above_chin_mm > 70.0)
    clothes = beside & (view.above_chin_mm < -50.0)
    return np.stack([skin, hair, clothes], axis=-1).astype(np.float32)


def beard_zone(view: Cells) -> Bool[np.ndarray, "r c"]:
    """Returns a mask of the cells on jaw, chin and upper lip."""
    low = (view.above_chin_mm > -20.0) & (view.above_chin_mm < 50.0)
    return view.on_head & low & (view.into_face_mm > -15.0)


def sideburn_zone(view: Cells) -> Bool[np.ndarray, "r c"]:
    """Returns a mask of the cells above the beard zone, between cheeks and ears, where only a beard can grow."""
    above = (view.above_chin_mm >= 50.0) & (view.above_chin_mm < 80.0)
    return view.on_head & above & (view.into_face_mm > -15.0) & (view.cheek < 0.5)


def beard_evidence(unlikeness: Float[np.ndarray, " n"], lower: Bool[np.ndarray, " n"]) -> float:
    """Returns a number from 0 (no beard) to 1 (beard), from the mean difference (``unlikeness``) between the lower face
    and cheeks with nose: below 0.12 without a beard, above 0.9 with one."""
    share = float(unlikeness[lower].mean()) if lower.any() else 0.0
    return float(_ramp(np.full((1, 1), share, np.float32), *BEARD_SHARE)[0, 0])


def place_prior(view: Cells, bearded: float = 0.0) -> Float32[np.ndarray, "r c 4"]:
    """Returns the prior probability of skin, hair, clothes, and none of them in each cell, from the cell's position and
    ``beard_evidence``."""
    face = _ramp(view.into_face_mm, -25.0, 15.0)
    upper = np.where(view.on_head, _ramp(view.above_chin_mm, -15.0, 45.0), _ramp(view.above_chin_mm, -45.0, 25.0))
    skin_above = np.where(view.on_head, 0.15 + 0.8 * face, 0.12)
    skin_below = np.where(view.on_head, 0.70, 0.2)
    hair_below = np.where(view.on_head, 0.10, 0.2)
    skin = upper * skin_above + (1.0 - upper) * skin_below
    hair = (1.0 - skin) * (upper * 0.93 + (1.0 - upper) * hair_below / (1.0 - skin_below))
    zone = beard_zone(view)
    skin, hair = np.where(zone, BARE_PRIOR[SKIN_CHANNEL], skin), np.where(zone, BARE_PRIOR[HAIR_CHANNEL], hair)
    grown = bearded * (zone | sideburn_zone(view))
    skin = skin + grown * (BEARD_PRIOR[SKIN_CHANNEL] - skin)
    hair = hair + grown * (BEARD_PRIOR[HAIR_CHANNEL] - hair)
    # A beard grows close about the lips, and hides the underside of the jaw.
    feature = view.feature - grown * np.minimum(view.feature, 1.0 - view.feature)
    known = np.maximum(feature, (1.0 - grown) * view.underside)
    named = np.maximum(skin, 0.985 * known)
    hair, skin = hair * (1.0 - named) / (1.0 - skin), named
    part = np.stack([skin, hair, 1.0 - skin - hair], axis=-1)
    other = OUTLIER * (1.0 - 0.98 * known[:, :, None])  # lips look like no other skin
    return np.concatenate([(1.0 - other) * part, other], axis=-1).astype(np.float32)


def _ramp(values: Float32[np.ndarray, "r c"], low: float, high: float) -> Float32[np.ndarray, "r c"]:
    t = np.clip((values - low) / (high - low), 0.0, 1.0)
    return t * t * (3.0 - 2.0 * t)


def unlike_cheeks(
    appearance: Int[np.ndarray, "n 2"], cheeks: Float32[np.ndarray, " n"]
) -> tuple[Float[np.ndarray, " n"], Float[np.ndarray, " n"]]:
    """Returns how much every cell differs (0 to 1) from the cells ``cheeks``, which are certainly skin: by colour
    alone, and by colour and fine structure. Fine structure separates a blond beard from skin, but it is also high at
    the borders of shadows."""
    everything = np.ones(len(appearance), np.float32)
    colour, detail = (
        (of(which, cheeks) / of(which, everything))[which]
        for which, of in ((appearance[:, 0], colour_histogram), (appearance[:, 1], detail_histogram))
    )
    first, second = ((SKIN_RATIO / (SKIN_RATIO + ratio)) ** 2 for ratio in (colour, colour * detail))
    return first, second


def fit_appearance(
    appearance: Int[np.ndarray, "n 2"],
    prior: Float32[np.ndarray, "n 4"],
    start: Float32[np.ndarray, "n 3"],
    lower: Bool[np.ndarray, " n"],
    unlikeness: Float[np.ndarray, " n"],
) -> Float32[np.ndarray, "n 4"]:
    """Learns the appearance of skin, hair and clothes by expectation maximisation. Returns the log likelihood of every
    cell under skin, hair, clothes and an outlier class, plus the logarithm of the probability that the subject shows
    this label at all.

    The fit of colours starts from the cells whose position decides their label; cells of hair and clothes have less
    weight the more they resemble skin."""
    colour, detail = appearance.T
    share = start.copy()
    share[:, HAIR_CHANNEL] = np.maximum(share[:, HAIR_CHANNEL], lower) * unlikeness
    share[:, CLOTHES_CHANNEL] *= unlikeness
    present = np.log(_presence(unlikeness, start, lower))
    logs = np.empty((len(colour), 4), np.float32)
    logs[:, 3] = STRENGTH * -np.log(OUTLIER_BINS)
    for step in range(STEPS):
        for part in (SKIN_CHANNEL, HAIR_CHANNEL, CLOTHES_CHANNEL):
            like = colour_histogram(colour, share[:, part])[colour] * detail_histogram(detail, share[:, part])[detail]
            logs[:, part] = STRENGTH * np.log(like) + present[part]
        if step < STEPS - 1:
            share = posterior(logs, prior)
            share[share < CONFIDENT] = 0.0
    return logs


def _presence(
    unlikeness: Float[np.ndarray, " n"], start: Float32[np.ndarray, "n 3"], lower: Bool[np.ndarray, " n"]
) -> Float[np.ndarray, " 3"]:
    """Returns the probability that the subject shows each label at all: for hair and clothes, how much the cells whose
    position decides this label differ from skin on average. A beard counts as hair."""
    shares = [float(unlikeness[place > 0].mean()) if place.any() else 0.0 for place in (*start.T, lower)]
    return np.maximum([1.0, max(shares[HAIR_CHANNEL], shares[3]), shares[CLOTHES_CHANNEL]], MIN_PRESENT)


def posterior(logs: Float32[np.ndarray, "n 4"], prior: Float[np.ndarray, "n 4"]) -> Float[np.ndarray, "n 3"]:
    """Returns the probability of skin, hair and clothes in each cell; the remainder to 1 is for outliers."""
    share = prior * np.exp(logs - logs.max(axis=1, keepdims=True))
    return share[:, :3] / share.sum(axis=1, keepdims=True)


def colour_histogram(colour: Int[np.ndarray, " n"], weight: Float32[np.ndarray, " n"]) -> Float[np.ndarray, " b"]:
    """Returns the smoothed probability of every colour bin, which is nowhere zero."""
    shape = (RED_BINS, BLUE_BINS, LIGHT_BINS)
    counts = np.bincount(colour, weight, np.prod(shape)).astype(np.float32)
    counts = counts.reshape(RED_BINS, BLUE_BINS * LIGHT_BINS)
    counts = cv2.GaussianBlur(counts, (1, 7), sigmaX=0.1, sigmaY=CHROMA_BLUR).reshape(shape)
    for slab in counts:
        slab[:] = cv2.GaussianBlur(slab, (0, 0), sigmaX=LIGHT_BLUR, sigmaY=CHROMA_BLUR)
    light = cv2.GaussianBlur(counts.sum(axis=(0, 1))[None], (0, 0), sigmaX=SHADE_BLUR, sigmaY=0.1)[0]
    shaded = counts.sum(axis=2, keepdims=True) * (light / max(light.sum(), 1e-9))
    return _proper(((1.0 - SHADE_SHARE) * counts + SHADE_SHARE * shaded).ravel().astype(float))


def detail_histogram(detail: Int[np.ndarray, " n"], weight: Float32[np.ndarray, " n"]) -> Float[np.ndarray, " d"]:
    """Returns the smoothed probability of every fine-structure bin, which is nowhere zero."""
    counts = np.bincount(detail, weight, DETAIL_BINS).astype(np.float32)[None]
    return _proper(cv2.GaussianBlur(counts, (0, 0), sigmaX=DETAIL_BLUR, sigmaY=0.1).ravel().astype(float))


def _proper(counts: Float[np.ndarray, " b"]) -> Float[np.ndarray, " b"]:
    even = 1.0 / len(counts)
    return (1.0 - FLOOR) * counts / max(counts.sum(), 1.0) + FLOOR * even


def upsample_guided(
    view: Cells,
    inside: Bool[np.ndarray, "r c"],
    share: Float32[np.ndarray, "n 3"],
    image: UInt8[np.ndarray, "h w 3"],
    mask: Bool[np.ndarray, "h w"],
) -> UInt8[np.ndarray, "h w 3"]:
    """Returns the cells' probabilities (255ths) at each pixel, smooth except at the photograph's edges."""
    grid = np.zeros((*inside.shape, 3), np.float32)
    grid[inside] = share
    radius = max(1, round(0.5 * SMOOTH_MM / CELL_MM))
    slope, offset = guided(view.grey, grid, inside.astype(np.float32), radius, EDGE)
    grey, smooth = np.asarray(cv2.cvtColor(image, cv2.COLOR_RGB2GRAY)), np.zeros((*mask.shape, 3), np.uint8)
    spread_parts(slope, offset, view.size_px, grey, mask, smooth)
    return smooth


def guided(
    guide: Float32[np.ndarray, "r c"],
    values: Float32[np.ndarray, "r c p"],
    weight: Float32[np.ndarray, "r c"],
    radius: int,
    edge: float,
) -> tuple[Float32[np.ndarray, "r c p"], Float32[np.ndarray, "r c p"]]:
    """Returns slope and offset of the guided filter: ``slope guide + offset`` is the smoothed value (He, Sun and Tang
    2010, eqs. 5, 6 and 8). ``weight`` is 0 where values are unknown; ``edge`` is the contrast of the guide image across
    which values are not smoothed."""

    def mean(field: np.ndarray) -> np.ndarray:
        return cv2.blur(field, (2 * radius + 1, 2 * radius + 1), borderType=cv2.BORDER_CONSTANT)

    known = np.maximum(mean(weight), 1e-6)
    middle = mean(guide * weight) / known
    spread = mean(guide * guide * weight) / known - middle * middle
    seen = values * weight[:, :, None]
    level = mean(seen) / known[:, :, None]
    shared = mean(seen * guide[:, :, None]) / known[:, :, None] - level * middle[:, :, None]
    slope = shared / (spread + edge * edge)[:, :, None]
    offset = level - slope * middle[:, :, None]
    slope, offset = (mean(each * weight[:, :, None]) / known[:, :, None] for each in (slope, offset))
    return slope, offset
