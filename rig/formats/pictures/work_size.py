"""Computes the reduced size at which large photographs are read, and the intrinsics for pictures of this size.

A head fills 60 % of a picture's height, so that a pixel of a four-megapixel picture covers 0.24 mm. The program
measures depth only at 0.4 mm (``PIXEL_MM`` of pipeline/stereo/estimate.py), and vertices are farther apart. The
program's limits in pixels were tuned on pictures of 0.8 Mpx. At 12 Mpx correct outlines still satisfy the limits in
pixels; at 24 Mpx correct outlines are reported to contradict their cameras."""

from dataclasses import replace

import cv2
import numpy as np
from jaxtyping import Float, UInt8

from rig.camera import Intrinsics
from rig.capture import Features
from rig.rig import Rig

# Eleven pictures with a plate each take 2.5 GB, at 6 Mpx 3.5 GB (`python -m tests.laboratory growth`).
WORK_PIXELS = 4_000_000
NEAR = 0.15  # a scale so near to a half or a quarter becomes it, since JPEG is decoded so at a third of the cost
HALVINGS_MOST = 3  # JPEG decoders reduce to 1/8 at most


def work_share(intrinsics: Intrinsics, pixels_most: int | None) -> float:
    """Returns the scale, 1 or less, at which a camera's pictures are read to have at most ``pixels_most`` pixels. None
    means full size."""
    pixels = intrinsics.width * intrinsics.height
    if pixels_most is None or pixels <= pixels_most:
        return 1.0
    share = (pixels_most / pixels) ** 0.5
    return next((h for h in (0.5, 0.25, 0.125) if abs(share / h - 1) < NEAR), share)


def work_rig(rig: Rig, pixels_most: int | None) -> Rig:
    """Returns the rig with intrinsics for pictures of at most ``pixels_most`` pixels."""
    shares = {camera.name: work_share(camera.intrinsics, pixels_most) for camera in rig}
    return replace(
        rig,
        cameras=tuple(
            camera if shares[camera.name] == 1.0 else replace(camera, intrinsics=camera.intrinsics.scaled(share))
            for camera, share in zip(rig, shares.values(), strict=True)
        ),
    )


def work_features(features: Features, rig: Rig, work: Rig) -> Features:
    """Converts feature points (px) from the original pictures to the reduced pictures."""

    def moved(name: str, pixel: Float[np.ndarray, " 2"]) -> Float[np.ndarray, " 2"]:
        full, scaled = rig[name].intrinsics, work[name].intrinsics
        return (pixel + 0.5) * (scaled.width / full.width, scaled.height / full.height) - 0.5

    return {point: {name: moved(name, at) for name, at in views.items()} for point, views in features.items()}


def halvings(share: float, size: tuple[int, int]) -> int:
    """Returns how many times a decoder may halve a picture of ``size`` (width, height) that will be scaled by
    ``share``.

    A decoder's halving stops if width or height is odd, so that every pixel averages a whole block."""
    count = 0
    while count < HALVINGS_MOST and share <= 0.5 ** (count + 1) and not any(side % 2 ** (count + 1) for side in size):
        count += 1
    return count


def at_share(
    pixels: UInt8[np.ndarray, "h w *channels"], size: tuple[int, int], share: float
) -> UInt8[np.ndarray, "r c *channels"]:
    """Resizes a picture to ``share`` times the ``size`` (width, height) of its file. A decoder may have reduced the
    array ``pixels`` before."""
    wanted = (round(size[0] * share), round(size[1] * share))
    if wanted == (pixels.shape[1], pixels.shape[0]):
        return pixels
    return cv2.resize(pixels, wanted, interpolation=cv2.INTER_AREA)
