"""Undistorts pictures, for programs that know no lens distortion.

Pixels are read by a spline at exact positions. OpenCV's remap rounds them to 1/32 px, which would shift a picture by up
to 0.016 px where only its principal point moves.
"""

import math

import numpy as np
from jaxtyping import Float, Float32, UInt8
from scipy.ndimage import map_coordinates, spline_filter

from rig.camera import Intrinsics

SPLINE_ORDER = 3


def pinhole_of(lens: Intrinsics, *, centred: bool = False) -> Intrinsics:
    """Returns the same camera without distortion. If ``centred``, it has square pixels and the principal point in the
    middle of the picture, as formats require that state only a field of view."""
    if not centred:
        return Intrinsics(lens.width, lens.height, lens.fx, lens.fy, lens.cx, lens.cy)
    focal = math.sqrt(lens.fx * lens.fy)
    return Intrinsics(lens.width, lens.height, focal, focal, 0.5 * (lens.width - 1), 0.5 * (lens.height - 1))


def undistorted_picture(
    picture: UInt8[np.ndarray, "h w 3"], lens: Intrinsics, pinhole: Intrinsics
) -> UInt8[np.ndarray, "y x 3"]:
    """Returns the picture that ``pinhole`` would have taken instead; black where the lens shows nothing."""
    if lens == pinhole:
        return picture
    places = _sampled_pixels(lens, pinhole)
    channels = []
    for channel in np.moveaxis(picture, 2, 0):
        smooth = spline_filter(channel.astype(float), SPLINE_ORDER, mode="mirror")
        channels.append(map_coordinates(smooth, places, order=SPLINE_ORDER, mode="constant", prefilter=False))
    return np.clip(np.rint(np.stack(channels, axis=2)), 0, 255).astype(np.uint8)


def undistorted_share(
    share: Float32[np.ndarray, "h w"], lens: Intrinsics, pinhole: Intrinsics
) -> Float32[np.ndarray, "y x"]:
    """Returns a mask's share of the subject in every pixel (0 to 1) in the pinhole's picture; 0 where the lens shows
    nothing."""
    if lens == pinhole:
        return share
    return map_coordinates(share, _sampled_pixels(lens, pinhole), order=1, mode="constant")


def _sampled_pixels(lens: Intrinsics, pinhole: Intrinsics) -> Float[np.ndarray, "2 y x"]:
    """Returns the row and column of the lens's picture for every pixel of the pinhole's; -1 beyond the turning radius
    of the distortion."""
    rows, columns = np.mgrid[: pinhole.height, : pinhole.width].astype(float)
    rays = np.stack([(columns - pinhole.cx) / pinhole.fx, (rows - pinhole.cy) / pinhole.fy], axis=-1).reshape(-1, 2)
    pixels = lens.distortion.apply(rays) * (lens.fx, lens.fy) + (lens.cx, lens.cy)
    pixels[np.hypot(*rays.T) > lens.distortion.max_valid_radius()] = -1.0
    return np.ascontiguousarray(pixels[:, ::-1].T).reshape(2, *rows.shape)
