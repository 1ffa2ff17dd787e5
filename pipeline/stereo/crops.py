"""Prepares the photographs for dense matching: grey pinhole crops around the subject, at several sizes.

A crop keeps its camera's pose and name, but has no lens distortion. Between crops a plane maps from one view to another
by a homography, which is nearly affine over a small window. With such crops each photograph is undistorted once instead
of in each comparison.
"""

from collections.abc import Mapping
from dataclasses import dataclass, replace

import cv2
import numpy as np
from jaxtyping import Float, Float32, UInt8

from pipeline.geometry.projection import packed_lens
from pipeline.imaging.grey import LUMINANCE, blur_growth, estimate_noise, noise_left
from pipeline.imaging.silhouette import Silhouette
from pipeline.stereo.depth_map_kernels import fill_lens_map
from rig.camera import Camera, Intrinsics
from rig.rig import Rig

Photograph = UInt8[np.ndarray, "h w 3"]

LEVELS = 4  # full, half, quarter, eighth
MARGIN_PX = 12  # about the subject: windows and the defocused edge
UNSEEN_PX = -1e6  # signed distance beyond the photograph's edge: the subject may go on there
MAX_UNSEEN_PX = -1e4  # what is left of that after any mixing with what is seen
HALVED_NOISE = 0.4  # what a blur by BLUR_PX and a mean of 2 x 2 pixels leave of white noise
BLUR_PX = 0.5  # before every halving, and of the full size: what is left is fit for bilinear reading


@dataclass(frozen=True, slots=True, eq=False)
class Level:
    """Holds a crop at one size: its camera, grey values and signed distances to the outline, in pixels of this size."""

    camera: Camera
    grey: Float32[np.ndarray, "h w"]
    distance_px: Float32[np.ndarray, "h w"]  # to the outline, negative inside and beyond the photograph
    noise: float  # standard deviation of ``grey``


@dataclass(frozen=True, slots=True, eq=False)
class Crop:
    """Holds one camera's picture of the subject, cropped and undistorted, as an image pyramid with ``levels``."""

    levels: tuple[Level, ...]
    colour: Photograph

    @property
    def camera(self) -> Camera:
        """Returns the pinhole camera of the crop at full size."""
        return self.levels[0].camera


def make_crops(
    images: Mapping[str, Photograph],
    silhouettes: Mapping[str, Silhouette],
    rig: Rig,
    *,
    pixel_mm: float,
    at_world: Float[np.ndarray, " 3"],
) -> list[Crop]:
    """Returns a crop for each camera with a photograph and a usable, non-empty silhouette.

    ``images``: RGB photographs, by camera name. ``silhouettes``: by camera name. ``rig``: the cameras. ``pixel_mm``:
    smallest width (mm, at ``at_world``) of a crop's pixel; finer photographs are scaled down. ``at_world``: about the
    middle of the subject (mm).
    """
    found = []
    for camera in rig:
        silhouette = silhouettes.get(camera.name)
        if camera.name in images and silhouette is not None and silhouette.quality.usable and silhouette.mask.any():
            found.append(_crop(camera, images[camera.name], silhouette, pixel_mm, at_world))
    return found


def _crop(
    camera: Camera, image: Photograph, silhouette: Silhouette, pixel_mm: float, at_world: Float[np.ndarray, " 3"]
) -> Crop:
    depth = max(1.0, float(camera.camera_from_world.apply(at_world)[2]))
    scale = min(1.0, depth / camera.intrinsics.fx / pixel_mm)
    pinhole = crop_camera(camera, silhouette, scale)
    k = pinhole.intrinsics
    x, y = lens_map(camera, pinhole)
    if scale < 1.0:  # or the pixels between are never read
        image = cv2.GaussianBlur(image, (0, 0), 0.5 / scale)
    colour = cv2.remap(image, x, y, cv2.INTER_CUBIC, borderMode=cv2.BORDER_REPLICATE)
    distance = cv2.remap(
        silhouette.distance, x, y, cv2.INTER_LINEAR, borderMode=cv2.BORDER_CONSTANT, borderValue=UNSEEN_PX
    )
    distance = np.where(distance > MAX_UNSEEN_PX, distance * scale, UNSEEN_PX).astype(np.float32)
    grey = colour.astype(np.float32) @ LUMINANCE
    noise = estimate_noise(image.astype(np.float32) @ LUMINANCE)
    blur = BLUR_PX * blur_growth(noise)
    levels = [Level(pinhole, _smooth(grey, blur), distance, noise_left(noise, blur))]
    for _ in range(1, LEVELS):
        grey, distance = _half(_smooth(grey, BLUR_PX)), 0.5 * _half(distance)
        noise = max(HALVED_NOISE * noise, 0.1)
        pinhole = replace(pinhole, intrinsics=pinhole.intrinsics.scaled(0.5))
        levels.append(Level(pinhole, grey, distance, noise))
    assert levels[-1].grey.shape == (k.height >> (LEVELS - 1), k.width >> (LEVELS - 1))
    return Crop(tuple(levels), colour)


def crop_camera(camera: Camera, silhouette: Silhouette, scale: float) -> Camera:
    """Returns a pinhole camera at the pose of ``camera`` whose image just contains the subject. The pinhole camera's
    pixels are 1 / ``scale`` as wide as the camera's. Width and height are multiples of 2^(``LEVELS`` - 1), for the
    image pyramid.

    Where the photograph cuts the subject off, the crop extends ``MARGIN_PX`` beyond the photograph; these pixels are
    marked as unseen.
    """
    row, column = np.flatnonzero(silhouette.mask.any(axis=1)), np.flatnonzero(silhouette.mask.any(axis=0))
    k = camera.intrinsics
    left, right = max(column[0] - MARGIN_PX, -MARGIN_PX), min(column[-1] + MARGIN_PX, k.width + MARGIN_PX)
    top, bottom = max(row[0] - MARGIN_PX, -MARGIN_PX), min(row[-1] + MARGIN_PX, k.height + MARGIN_PX)
    across, down = np.linspace(left, right, 33), np.linspace(top, bottom, 33)
    border = np.concatenate(
        [np.stack([across, np.full(33, y)], 1) for y in (top, bottom)]
        + [np.stack([np.full(33, x), down], 1) for x in (left, right)]
    )
    normalised = camera.undistort(border)
    normalised = normalised[np.isfinite(normalised).all(axis=1)]
    fx, fy = k.fx * scale, k.fy * scale
    low, high = normalised.min(axis=0) * (fx, fy), normalised.max(axis=0) * (fx, fy)
    step = 2 ** (LEVELS - 1)
    width, height = (int(np.ceil((b - a) / step)) * step for a, b in zip(low, high, strict=True))
    return replace(camera, intrinsics=Intrinsics(width, height, fx, fy, -float(low[0]), -float(low[1])))


def lens_map(camera: Camera, pinhole: Camera) -> tuple[Float32[np.ndarray, "h w"], Float32[np.ndarray, "h w"]]:
    """Returns the column and the row (px) in the camera's photograph for each pixel of ``pinhole``, a camera with the
    same pose."""
    k = pinhole.intrinsics
    x, y = np.empty((k.height, k.width), np.float32), np.empty((k.height, k.width), np.float32)
    fill_lens_map(k.values()[:4], packed_lens(camera), x, y)
    return x, y


def _smooth(grey: Float32[np.ndarray, "h w"], sigma_px: float) -> Float32[np.ndarray, "h w"]:
    return cv2.GaussianBlur(grey, (0, 0), sigma_px)


def _half(values: Float32[np.ndarray, "h w"]) -> Float32[np.ndarray, "h2 w2"]:
    return cv2.resize(values, None, fx=0.5, fy=0.5, interpolation=cv2.INTER_AREA)
