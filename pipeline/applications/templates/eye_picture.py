"""Paints an eyeball as the photographs show it: an image about the iris, equidistant in angle.

The part between the lids has the head's texture; hidden parts have the median colour of their ring of the iris, or of
the white."""

from dataclasses import dataclass

import cv2
import numpy as np
from jaxtyping import Bool, Float, Int, UInt8

from pipeline.applications.templates.eyeballs import LIMBUS_MM, Eyeball, turn_to
from pipeline.geometry.surface_index import SurfaceIndex
from pipeline.texturing.layout.uv_unwrap import Atlas
from rig.mesh import Mesh

SIZE_PX = 512  # a texel is 0.15 mm, about a pixel of a photograph
FRONT_DEG = 75.0  # from the gaze: lids hide what is farther
ASIDE_MM = 0.5  # between a point of the ball and the nearest one between the lids, along the ball: more is hidden
FEATHER_PX = 6  # over which what is seen fades to what is guessed
RING_DEG = 1.0
MIN_SEEN = 0.3  # of the iris
BRIGHT = 0.7  # of what is seen beside the iris, the share that lids and their shadow may be
DARK_SHARES, DARK = (0.2, 0.9), 0.5  # of what is seen, and of its brightness: a pupil and an iris beside the white


@dataclass(frozen=True, slots=True, eq=False)
class PhotographedEyes:
    """Holds the head as photographed (head frame, mm), the numbers of its triangles between lids and lips, and its
    texture, if it has one."""

    head: Mesh
    between: Int[np.ndarray, " g"]
    atlas: Atlas | None


def eyeball_uv(eyeball: Eyeball, mesh: Mesh) -> Float[np.ndarray, "n 2"]:
    """Returns the coordinates of an eyeball's vertices, which looks ahead, in its image."""
    away = mesh.vertices - eyeball.centre
    angle = np.arctan2(np.hypot(away[:, 0], away[:, 1]), away[:, 2])
    aside = np.hypot(away[:, 0], away[:, 1])
    along = np.where(aside[:, None] > 1e-9, away[:, :2] / np.maximum(aside, 1e-9)[:, None], (1.0, 0.0))
    return 0.5 + 0.5 * (angle / np.pi)[:, None] * along * (1.0, -1.0)


def paint_eyeball(eyeball: Eyeball, photographed: PhotographedEyes) -> UInt8[np.ndarray, "s s 3"] | None:
    """Returns the image of an eyeball (sRGB), or None if too little of its iris is seen."""
    angle, front, directions = _front(eyeball.gaze)
    colours, seen = _photographed(eyeball, directions, photographed)
    iris = angle[front] < np.arcsin(LIMBUS_MM / eyeball.radius_mm)
    if seen[iris].mean() < MIN_SEEN or not seen[~iris].any():
        return None
    ring = (np.degrees(angle[front]) / RING_DEG).astype(int)
    beside, light = seen & ~iris, colours.mean(axis=1)
    white = np.median(colours[beside & (light >= np.quantile(light[beside], BRIGHT))], axis=0)
    guess = np.tile(white, (len(ring), 1))
    for number in np.unique(ring[iris]):
        rows = ring == number
        guess[rows] = np.median(colours[rows & seen], axis=0) if (rows & seen).any() else white
    shown = np.zeros(angle.shape, np.uint8)
    shown[front] = seen
    share = np.minimum(cv2.distanceTransform(shown, cv2.DIST_L2, 5) / FEATHER_PX, 1.0)[front][:, None]
    image = np.tile(white, (SIZE_PX, SIZE_PX, 1))
    image[front] = share * colours + (1.0 - share) * guess
    return np.clip(np.rint(image), 0, 255).astype(np.uint8)


def darkest_direction(eyeball: Eyeball, photographed: PhotographedEyes) -> Float[np.ndarray, " 3"] | None:
    """Returns the direction (unit vector) from the eyeball to the middle of what is darkest between the lids; None if
    nothing is much darker than the rest, as between closed lids."""
    _, _, directions = _front(eyeball.gaze)
    colours, seen = _photographed(eyeball, directions, photographed)
    if not seen.any():
        return None
    light = colours[seen].mean(axis=1)
    dark, bright = np.quantile(light, DARK_SHARES)
    towards = directions[seen][light < dark].mean(axis=0) if dark < DARK * bright else None
    return None if towards is None else towards / np.linalg.norm(towards)


def _front(
    gaze: Float[np.ndarray, " 3"],
) -> tuple[Float[np.ndarray, "s s"], Bool[np.ndarray, "s s"], Float[np.ndarray, "n 3"]]:
    """Returns the angle from the gaze (rad) of each texel, which texels are in front, and their directions."""
    offsets = (np.arange(SIZE_PX) + 0.5) / SIZE_PX - 0.5
    x, y = np.meshgrid(offsets, -offsets)
    angle = 2.0 * np.pi * np.hypot(x, y)
    front = angle < np.radians(FRONT_DEG)
    ahead = np.sinc(angle[front] / np.pi)[:, None] * 2.0 * np.pi * np.stack([x[front], y[front]], axis=1)
    return angle, front, np.column_stack([ahead, np.cos(angle[front])]) @ turn_to(gaze).T


def _photographed(
    eyeball: Eyeball, directions: Float[np.ndarray, "n 3"], photographed: PhotographedEyes
) -> tuple[Float[np.ndarray, "n 3"], Bool[np.ndarray, " n"]]:
    """Returns the head's colours (sRGB) in these directions of an eyeball, and which of them no lid hides."""
    head, atlas = photographed.head, photographed.atlas
    if atlas is None or not len(photographed.between):
        return np.zeros_like(directions), np.zeros(len(directions), bool)
    layout, image = atlas.layout, atlas.image
    points = eyeball.centre + eyeball.reach(directions)[:, None] * directions
    hits = SurfaceIndex(head.vertices, head.faces[photographed.between]).closest(points)
    off = hits.points - points
    aside = off - np.einsum("nx,nx->n", off, directions)[:, None] * directions
    corners = layout.uv[layout.faces[photographed.between[hits.triangles]]]
    texels = (np.einsum("nk,nkx->nx", hits.weights, corners) * len(image) - 0.5).astype(np.float32)
    rows = np.resize(texels, (-(-len(texels) // SIZE_PX), SIZE_PX, 2))  # remap takes no more than 32,767 in a row
    colours = cv2.remap(image, rows[..., 0], rows[..., 1], cv2.INTER_LINEAR, borderMode=cv2.BORDER_REPLICATE)
    return np.asarray(colours, float).reshape(-1, 3)[: len(texels)], np.linalg.norm(aside, axis=1) < ASIDE_MM
