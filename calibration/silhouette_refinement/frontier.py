"""Finds frontier points: points where an epipolar plane touches the subject, seen on the silhouettes of two cameras.

Consider the angle of a contour's rays about the line through both camera centres. At a local extreme of the angle the
epipolar plane touches the subject, and unless something hides that point, the other contour has an extreme at the same
angle. ``pipeline.multiview.tangency`` uses the two outermost extremes of a pair; a head with hair and shoulders has
several more. Only convex extremes count: where two parts of an outline cross (a T-junction) the contour has a concave
corner that is no point of the subject. Extremes are paired by their angles, so the cameras must be accurate to about
``GATE_PX`` already."""

from collections.abc import Mapping
from dataclasses import dataclass
from itertools import combinations

import cv2
import numpy as np
from jaxtyping import Bool, Float
from scipy.ndimage import gaussian_filter1d, maximum_filter1d

from pipeline.imaging.silhouette import Silhouette
from pipeline.multiview.tangency import (
    BORDER_PX,
    LONGEST_SPAN,
    MIN_SLOPE,
    Tangency,
    angle_slopes,
    epipolar_plane_axes,
    on_contour,
    rays_about,
    tangency,
)
from rig.camera import Camera
from rig.rig import Rig

GATE_PX = 2.5  # largest distance of two extremes that count as one frontier point
REACH = 15  # contour pixels to either side among which an extreme must be the largest
PROMINENCE_PX = 0.3  # by so much: an outline straighter than a radius of 400 px does not locate an extreme
SMOOTH_PX = 1.0  # smoothing along the contour; it shifts a bend of radius r by 1 / (2 r) px
INSIDE_PX = 4.0  # at this distance behind a convex extreme the mask must show the subject


@dataclass(frozen=True, slots=True, eq=False)
class Contour:
    """Holds the longest closed outline of a silhouette, in order: sub-pixel positions, unit rays in the world frame,
    and which pixels are ``whole`` (not at the picture's border)."""

    camera: Camera
    mask: Bool[np.ndarray, "h w"]
    pixels: Float[np.ndarray, "n 2"]
    rays: Float[np.ndarray, "n 3"]
    whole: Bool[np.ndarray, " n"]

    @classmethod
    def of(cls, camera: Camera, silhouette: Silhouette) -> "Contour":
        """Extracts the outline of a silhouette, smoothed by ``SMOOTH_PX``."""
        outlines, _ = cv2.findContours(silhouette.mask.astype(np.uint8), cv2.RETR_EXTERNAL, cv2.CHAIN_APPROX_NONE)
        chain = max(outlines, key=len).reshape(-1, 2).astype(float)
        pixels = gaussian_filter1d(on_contour(chain, silhouette.distance), SMOOTH_PX, axis=0, mode="wrap")
        far = np.array([camera.intrinsics.width, camera.intrinsics.height]) - 1.0
        margin = np.minimum(chain, far - chain).min(axis=1)
        whole = -maximum_filter1d(-margin, 2 * REACH + 1, mode="wrap") >= BORDER_PX
        return cls(camera, silhouette.mask, pixels, camera.rays_world(pixels), whole)


@dataclass(frozen=True, slots=True, eq=False)
class _Extremes:
    """Holds the local extremes of the angle along one contour: angle (rad), +1 for maxima and -1 for minima, pixel, and
    the angle's change per pixel."""

    angle: Float[np.ndarray, " e"]
    side: Float[np.ndarray, " e"]
    pixels: Float[np.ndarray, "e 2"]
    slopes: Float[np.ndarray, "e 2"]


def find_frontier(silhouettes: Mapping[str, Silhouette], rig: Rig, gate_px: float = GATE_PX) -> list[Tangency]:
    """Returns the frontier points of every pair of cameras that both contours show without ambiguity. ``rig`` must
    contain only cameras with a usable silhouette."""
    contours = [Contour.of(camera, silhouettes[camera.name]) for camera in rig]
    frontier = []
    for one, two in combinations(contours, 2):
        frontier += _pair(one, two, gate_px)
    return frontier


def _pair(one: Contour, two: Contour, gate_px: float) -> list[Tangency]:
    u, v = epipolar_plane_axes(one.camera, two.camera, one.rays.mean(axis=0) + two.rays.mean(axis=0))
    angles = [np.arctan2(contour.rays @ v, contour.rays @ u) for contour in (one, two)]
    if max(np.ptp(angle) for angle in angles) > LONGEST_SPAN:
        return []
    first, second = (_extremes(c, angle, u, v) for c, angle in zip((one, two), angles, strict=True))
    if not len(first.angle) or not len(second.angle):
        return []
    steepness = np.linalg.norm(first.slopes, axis=1)
    other_steepness = np.linalg.norm(second.slopes, axis=1)
    apart = (
        np.abs(first.angle[:, None] - second.angle[None, :])
        / np.hypot(steepness[:, None], other_steepness[None, :])
        * np.sqrt(2.0)
    )
    apart[first.side[:, None] != second.side[None, :]] = np.inf
    frontier = []
    for i, j in zip(*np.nonzero(apart < gate_px), strict=True):
        rivals = np.concatenate([np.delete(apart[i], j), np.delete(apart[:, j], i)])
        if len(rivals) and rivals.min() < 2.0 * gate_px:
            continue
        names, pixels = (one.camera.name, two.camera.name), (first.pixels[i], second.pixels[j])
        difference = float(first.angle[i] - second.angle[j])
        frontier.append(tangency(names, pixels, (first.slopes[i], second.slopes[j]), difference, float(first.side[i])))
    return frontier


def _extremes(contour: Contour, angle: Float[np.ndarray, " n"], u: np.ndarray, v: np.ndarray) -> _Extremes:
    tops = maximum_filter1d(angle, 2 * REACH + 1, mode="wrap") == angle
    bottoms = maximum_filter1d(-angle, 2 * REACH + 1, mode="wrap") == -angle
    at = np.flatnonzero((tops | bottoms) & contour.whole)
    side = np.where(tops[at], 1.0, -1.0)
    pixels = contour.pixels[at]
    slopes = angle_slopes(rays_about(contour.camera, pixels), u, v)
    steep = np.linalg.norm(slopes, axis=1)
    ends = np.maximum(side * angle[at - REACH], side * angle[(at + REACH) % len(angle)])
    behind = pixels - INSIDE_PX * (side / np.maximum(steep, 1e-12))[:, None] * slopes
    height, width = contour.mask.shape
    x, y = np.rint(np.clip(behind, 0, [width - 1, height - 1])).astype(int).T
    good = (steep > MIN_SLOPE) & (side * angle[at] - ends > PROMINENCE_PX * steep) & contour.mask[y, x]
    return _Extremes(angle[at][good], side[good], pixels[good], slopes[good])
