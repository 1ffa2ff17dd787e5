"""The photographs as photo-consistency reads them: grey, with their noise, blurred to the size that is asked for."""

from collections.abc import Mapping
from concurrent.futures import ThreadPoolExecutor
from dataclasses import dataclass

import cv2
import numpy as np
from jaxtyping import Bool, Float, Float32, UInt8

from pipeline.fitting.rim import Views
from pipeline.imaging.grey import LUMINANCE, blur_growth, noise_level
from pipeline.parallel_for import thread_count

LEAST_BLUR_PX = 0.7  # below that a bilinear sample is mostly interpolation error
UNKNOWN_NOISE = 0.5  # share of the noise: the contrast of a window holds it once already
INSIDE_PX, TEXTURE_BLUR_PX, TEXTURE_NOISES = 4.0, 2.0, 5.0


@dataclass(frozen=True, slots=True, eq=False)
class Photographs:
    """Of the solver's views: pictures in grey, the noise (grey levels) of each, and whether it shows anything at all. A
    view without a photograph is black."""

    grey: tuple[Float32[np.ndarray, "_ _"], ...]
    noise: Float[np.ndarray, " k"]
    speaks: Bool[np.ndarray, " k"]


def load_photographs(images: Mapping[str, UInt8[np.ndarray, "h w 3"]], views: Views) -> Photographs:
    """Those of the views; a view without a photograph, or with nothing to see in it, does not speak."""
    grey, noise, speaks = [], [], []
    for k, name in enumerate(views.names):
        width, height = views.size[k]
        image = images.get(name, np.zeros((height, width, 3), np.uint8))
        grey.append(image.astype(np.float32) @ LUMINANCE)
        noise.append(noise_level(grey[-1]))
        speaks.append(shows_texture(grey[-1], distance_of(views, k) < -INSIDE_PX, noise[-1]))
    return Photographs(tuple(grey), np.array(noise), np.array(speaks))


def distance_of(views: Views, k: int) -> Float32[np.ndarray, "h w"]:
    """The signed distance of one view."""
    width, height = views.size[k]
    return views.distance[views.offset[k] : views.offset[k] + width * height].reshape(height, width)


def shows_texture(grey: Float32[np.ndarray, "h w"], inside: Bool[np.ndarray, "h w"], noise: float) -> bool:
    """Is there more than noise inside the silhouette, and not half of it burnt out or black? A mask that stands in for
    a photograph is one even value there."""
    if not inside.any():
        return False
    smooth = cv2.GaussianBlur(grey, (0, 0), TEXTURE_BLUR_PX)[inside]
    detail = float(np.std(smooth))
    exposed = float(np.mean((grey[inside] > 2.0) & (grey[inside] < 253.0)))
    sharp = detail > TEXTURE_NOISES * noise / (2.0 * np.sqrt(np.pi) * TEXTURE_BLUR_PX)
    return bool(sharp and exposed > 0.5)


def blurred(
    photographs: Photographs, sigma_px: Float[np.ndarray, " k"]
) -> tuple[Float32[np.ndarray, " n"], np.ndarray]:
    """All images, blurred, in one row, and what a comparison adds to their norms for the noise that is left: white
    noise falls by 2 sqrt(pi) sigma."""
    growth = np.array([blur_growth(noise) for noise in photographs.noise.tolist()])
    sigma = np.maximum(sigma_px, LEAST_BLUR_PX * growth)
    with ThreadPoolExecutor(thread_count()) as pool:
        smooth = pool.map(lambda i, s: cv2.GaussianBlur(i, (0, 0), s).ravel(), photographs.grey, sigma.tolist())
        left = photographs.noise / (2.0 * np.sqrt(np.pi) * sigma)
        return np.concatenate(list(smooth)), UNKNOWN_NOISE * left
