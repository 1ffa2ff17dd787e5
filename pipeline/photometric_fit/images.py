"""Prepares the photographs for photo-consistency: converts them to grey, measures noise, removes shading where
required, and blurs.

Shading varies slowly over the face, and its glossy part moves with the camera. Matching glossy shading puts the surface
behind a convex surface and in front of a concave one: by 3 to 5 mm on oily skin, with cameras 12 degrees apart. Pores,
moles and lashes are small and do not move on the skin."""

from collections.abc import Mapping
from dataclasses import dataclass, replace

import cv2
import numpy as np
from jaxtyping import Bool, Float, Float32, UInt8

from pipeline.compute.threads import map_in_threads
from pipeline.contour_fit.rim import Views
from pipeline.imaging.grey import LUMINANCE, estimate_noise

MIN_BLUR_PX = 0.7  # below that a bilinear sample is mostly interpolation error
INSIDE_PX, TEXTURE_BLUR_PX, TEXTURE_NOISES = 4.0, 2.0, 5.0
SHADING_MM = 1.5  # standard deviation of the mean that is taken off; three-brows: 0.69 mm with 1.5, 0.81 with 2
MIN_COVERAGE = 1e-3  # share of a window inside the silhouette


@dataclass(frozen=True, slots=True, eq=False)
class Photographs:
    """Holds, for each view of the solver, the grey photograph, its noise (standard deviation, grey levels), and whether
    it contains texture (``speaks``). A view without a photograph is black."""

    grey: tuple[Float32[np.ndarray, "_ _"], ...]
    noise: Float[np.ndarray, " k"]
    speaks: Bool[np.ndarray, " k"]


def load_photographs(images: Mapping[str, UInt8[np.ndarray, "h w 3"]], views: Views) -> Photographs:
    """Converts the photographs to grey and measures their noise. ``speaks`` is False for a view without a photograph,
    or without texture inside its silhouette."""

    def load(k: int) -> tuple[Float32[np.ndarray, "h w"], float, bool]:
        width, height = views.size[k]
        image = images.get(views.names[k], np.zeros((height, width, 3), np.uint8))
        grey = image.astype(np.float32) @ LUMINANCE
        noise = estimate_noise(grey)
        return grey, noise, shows_texture(grey, views.distance_map(k) < -INSIDE_PX, noise)

    grey, noise, speaks = zip(*map_in_threads(load, len(views.names)), strict=True)
    return Photographs(grey, np.array(noise), np.array(speaks))


def fine_texture(photographs: Photographs, views: Views, px_per_mm: Float[np.ndarray, " k"]) -> Photographs:
    """Returns the photographs without shading, so that fine texture remains. ``px_per_mm`` is the number of pixels that
    a millimetre on the head covers in each view."""

    def fine(k: int) -> Float32[np.ndarray, "h w"]:
        return remove_shading(photographs.grey[k], views.distance_map(k) < 0.0, SHADING_MM * float(px_per_mm[k]))

    return replace(photographs, grey=tuple(map_in_threads(fine, len(photographs.grey))))


def remove_shading(
    grey: Float32[np.ndarray, "h w"], inside: Bool[np.ndarray, "h w"], sigma_px: float
) -> Float32[np.ndarray, "h w"]:
    """Returns the difference between an image and its Gaussian mean over the silhouette; 0 outside the silhouette."""
    out = np.zeros_like(grey)
    rows, columns = np.flatnonzero(inside.any(axis=1)), np.flatnonzero(inside.any(axis=0))
    if not len(rows):
        return out
    box = slice(rows[0], rows[-1] + 1), slice(columns[0], columns[-1] + 1)
    weight = inside[box].astype(np.float32)
    mean = cv2.GaussianBlur(grey[box] * weight, (0, 0), sigma_px)
    mean /= np.maximum(cv2.GaussianBlur(weight, (0, 0), sigma_px), MIN_COVERAGE)
    out[box] = np.where(inside[box], grey[box] - mean, np.float32(0.0))
    return out


def shows_texture(grey: Float32[np.ndarray, "h w"], inside: Bool[np.ndarray, "h w"], noise: float) -> bool:
    """Returns whether the pixels inside the silhouette vary by more than noise, and more than half of them are neither
    overexposed nor black. A mask that was supplied in place of a photograph is constant there and gives False."""
    if not inside.any():
        return False
    smooth = cv2.GaussianBlur(grey, (0, 0), TEXTURE_BLUR_PX)[inside]
    detail = float(np.std(smooth))
    exposed = float(np.mean((grey[inside] > 2.0) & (grey[inside] < 253.0)))
    sharp = detail > TEXTURE_NOISES * noise / (2.0 * np.sqrt(np.pi) * TEXTURE_BLUR_PX)
    return bool(sharp and exposed > 0.5)


def blur_images(
    photographs: Photographs, sigma_px: Float[np.ndarray, " k"]
) -> tuple[Float32[np.ndarray, " n"], np.ndarray]:
    """Blurs each image with its standard deviation ``sigma_px``. Returns all images one after another in a flat array,
    and the remaining noise of each image: a blur divides white noise by 2 sqrt(pi) sigma."""
    sigma = np.maximum(sigma_px, MIN_BLUR_PX)
    grey = photographs.grey
    smooth = map_in_threads(lambda k: cv2.GaussianBlur(grey[k], (0, 0), float(sigma[k])).ravel(), len(grey))
    return np.concatenate(smooth), photographs.noise / (2.0 * np.sqrt(np.pi) * sigma)
