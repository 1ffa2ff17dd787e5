"""Finds epipolar tangencies: a plane through two camera centres that touches the subject's silhouette in one view also
touches it in the other view.

The input is two silhouettes and their cameras. The output is pairs of contour points that one plane should touch, and
their error (Wong and Cipolla, *Structure and motion from silhouettes*, ICCV 2001)."""

from collections.abc import Mapping
from dataclasses import dataclass
from itertools import combinations

import cv2
import numpy as np
from jaxtyping import Float

from pipeline.imaging.silhouette import Silhouette
from rig.camera import Camera
from rig.geometry import cross_matrix
from rig.rig import Rig

Vector = Float[np.ndarray, " 3"]

BORDER_PX = 4.0  # a tangent this near the image border may belong to what the border has cut off
LONGEST_SPAN = 2.0  # angle (rad) of a silhouette about the baseline: beyond, the epipole lies in or near it
MIN_SLOPE = 1e-9  # rad a pixel: at the epipole a plane has no direction


@dataclass(frozen=True, slots=True, eq=False)
class Tangency:
    """Holds one tangent plane of two cameras; each attribute has one value for each camera.

    Attributes:
        cameras: names of the cameras.
        pixels: the point of the outline that the plane touches.
        steepness: how much the plane turns about the line through both centres for each pixel across the epipolar line,
            rad.
        normals: unit normal of the epipolar line in the image.
        excess_px: how far the outline reaches along the normal beyond the other camera's plane.
        outward: 1.0 if the normals point out of the subject, else -1.0.
    """

    cameras: tuple[str, str]
    pixels: tuple[Float[np.ndarray, " 2"], Float[np.ndarray, " 2"]]
    steepness: tuple[float, float]
    normals: tuple[Float[np.ndarray, " 2"], Float[np.ndarray, " 2"]]
    excess_px: tuple[float, float]
    outward: float


def find_tangencies(silhouettes: Mapping[str, Silhouette], rig: Rig, inset_mm: float = 0.0) -> list[Tangency]:
    """Finds the outer tangent planes of every two cameras, on each side where both images contain the whole subject.
    With ``inset_mm``, the planes touch curves inside the outlines, at this distance measured at the subject."""
    middle = rig.centre_world()
    insets_px = {camera.name: inset_mm / pixel_mm(camera, middle) if inset_mm else 0.0 for camera in rig}
    outlines = {camera.name: _Outline.of(camera, silhouettes[camera.name], insets_px[camera.name]) for camera in rig}
    found = []
    for one, two in combinations(rig, 2):
        if len(outlines[one.name].pixels) and len(outlines[two.name].pixels):
            found += _pair(outlines[one.name], outlines[two.name], one, two)
    return found


def pixel_mm(camera: Camera, place_world: Vector) -> float:
    """Returns the width (mm) that a pixel covers at the distance of a point."""
    return float(np.linalg.norm(place_world - camera.centre_world)) / camera.intrinsics.fx


@dataclass(frozen=True, slots=True, eq=False)
class _Outline:
    """Holds the convex hull of a mask, because outer tangents touch nothing else."""

    pixels: Float[np.ndarray, "n 2"]
    rays: Float[np.ndarray, "n 3"]
    size: tuple[int, int]

    @classmethod
    def of(cls, camera: Camera, silhouette: Silhouette, inset_px: float) -> "_Outline":
        hull = outer_hull(silhouette, inset_px)
        return cls(hull, camera.rays_world(hull), (camera.intrinsics.width, camera.intrinsics.height))

    def cut(self, i: int) -> bool:
        x, y = self.pixels[i]
        return bool(min(x, y, self.size[0] - 1 - x, self.size[1] - 1 - y) < BORDER_PX)


def outer_hull(silhouette: Silhouette, inset_px: float = 0.0) -> Float[np.ndarray, "n 2"]:
    """Returns the corners (px) of the convex hull of a mask with sub-pixel accuracy; empty for an empty mask.

    With ``inset_px``, the hull is that of a curve inside the contour at this distance. The inset curve excludes strands
    and specks thinner than twice ``inset_px``."""
    inside = silhouette.distance < -inset_px if inset_px else silhouette.mask
    contours, _ = cv2.findContours(inside.astype(np.uint8), cv2.RETR_EXTERNAL, cv2.CHAIN_APPROX_NONE)
    if not contours:
        return np.zeros((0, 2))
    hull = cv2.convexHull(np.concatenate(contours)).reshape(-1, 2).astype(float)
    return on_contour(hull, silhouette.distance + np.float32(inset_px))


def on_contour(pixels: Float[np.ndarray, "n 2"], distance: Float[np.ndarray, "h w"]) -> Float[np.ndarray, "n 2"]:
    """Returns the pixel centres at the mask's edge after moving them along the gradient of the signed distance onto the
    contour."""
    height, width = distance.shape
    x, y = pixels.astype(int).T
    left, right = np.maximum(x - 1, 0), np.minimum(x + 1, width - 1)
    up, down = np.maximum(y - 1, 0), np.minimum(y + 1, height - 1)
    slope = 0.5 * np.stack([distance[y, right] - distance[y, left], distance[down, x] - distance[up, x]], axis=1)
    norm = np.maximum(np.linalg.norm(slope, axis=1, keepdims=True), 0.5)
    return pixels - np.clip(distance[y, x], -1.5, 1.5)[:, None] * slope / norm**2


def _pair(first: _Outline, second: _Outline, one: Camera, two: Camera) -> list[Tangency]:
    u, v = epipolar_plane_axes(one, two, first.rays.mean(axis=0) + second.rays.mean(axis=0))
    angles = [np.arctan2(outline.rays @ v, outline.rays @ u) for outline in (first, second)]
    if max(np.ptp(angle) for angle in angles) > LONGEST_SPAN:
        return []
    found = []
    for pick, outward in ((np.argmax, 1.0), (np.argmin, -1.0)):
        i, j = int(pick(angles[0])), int(pick(angles[1]))
        if first.cut(i) or second.cut(j):
            continue
        pixels = first.pixels[i], second.pixels[j]
        slopes = [
            angle_slopes(rays_about(camera, pixel), u, v) for camera, pixel in zip((one, two), pixels, strict=True)
        ]
        if min(np.linalg.norm(slope) for slope in slopes) >= MIN_SLOPE:
            difference = float(angles[0][i] - angles[1][j])
            found.append(tangency((one.name, two.name), pixels, (slopes[0], slopes[1]), difference, outward))
    return found


def epipolar_plane_axes(one: Camera, two: Camera, towards: Vector) -> tuple[Vector, Vector]:
    """Returns two unit vectors u, v (world) perpendicular to the line through both camera centres. A plane through this
    line and a ray has the angle ``arctan2(ray @ v, ray @ u)``, measured from the direction ``towards``."""
    axis = two.centre_world - one.centre_world
    axis = axis / max(float(np.linalg.norm(axis)), 1e-9)
    u = towards - axis * (towards @ axis)
    u = u / max(float(np.linalg.norm(u)), 1e-9)
    return u, cross_matrix(axis) @ u


def rays_about(camera: Camera, pixels: Float[np.ndarray, "*n 2"]) -> Float[np.ndarray, "*n 4 3"]:
    """Returns the unit rays (world frame) through the four pixels to the right and left of, below and above each given
    pixel."""
    around = pixels[..., None, :] + np.array([[1.0, 0.0], [-1.0, 0.0], [0.0, 1.0], [0.0, -1.0]])
    return camera.rays_world(around.reshape(-1, 2)).reshape(*around.shape[:-1], 3)


def angle_slopes(around: Float[np.ndarray, "*n 4 3"], u: Vector, v: Vector) -> Float[np.ndarray, "*n 2"]:
    """Returns the derivatives of the epipolar plane's angle by a pixel's position (rad per px), by x and by y.
    ``around`` comes from ``rays_about``; ``u`` and ``v`` come from ``epipolar_plane_axes``."""
    angle = np.arctan2(around @ v, around @ u)
    return np.stack([angle[..., 0] - angle[..., 1], angle[..., 2] - angle[..., 3]], axis=-1) / 2.0


def tangency(
    cameras: tuple[str, str],
    pixels: tuple[Float[np.ndarray, " 2"], Float[np.ndarray, " 2"]],
    slopes: tuple[Float[np.ndarray, " 2"], Float[np.ndarray, " 2"]],
    difference: float,
    outward: float,
) -> Tangency:
    """Builds the tangency of two contour points that the same plane should touch.

    Args:
        cameras: names of the cameras.
        pixels: the contour point in each image.
        slopes: ``angle_slopes`` at both points.
        difference: angle of the plane through the first point minus that through the second, rad.
        outward: 1.0 if the angle grows out of the subject, else -1.0.
    """
    steepness = float(np.linalg.norm(slopes[0])), float(np.linalg.norm(slopes[1]))
    normals = slopes[0] / steepness[0], slopes[1] / steepness[1]
    excess_px = difference / steepness[0], -difference / steepness[1]
    return Tangency(cameras, pixels, steepness, normals, excess_px, outward)
