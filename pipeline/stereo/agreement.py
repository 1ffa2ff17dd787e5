"""Keeps of the depth maps what other views confirm: a surface point counts only where another view has it too."""

from collections.abc import Sequence

import numpy as np
from jaxtyping import Bool, Float32, UInt8

from pipeline.compute.threads import map_in_threads
from pipeline.stereo.agreement_kernels import count_agreeing
from pipeline.stereo.crops import Crop
from pipeline.stereo.depth_map import DepthMap, placing
from pipeline.stereo.depth_map_kernels import normals_of_known
from pipeline.stereo.field import Field
from pipeline.stereo.stack import Stack
from rig.camera import Camera

MAX_DEVIATION_MM = 2.0  # a depth with a larger standard deviation is discarded
OUTLINE_PX = 1.0  # no depth nearer to the background: the edge is blurred over it
AGREE_MM = 1.5  # two views agree where their surfaces are nearer than that ...
AGREE_DEVIATIONS = 3.0  # ... and than this many of their joint standard deviation


# Views that see past a place, for each that has it too: they may err as well. At 1 a tenth of the hair is lost, without
# a bound a percent of what is told lies more than 2 mm off.
MAX_CONTRADICTING_VIEWS = 2


# Variance along the ray of what the views agree on, by features that say it on two captures rendered by another program
# (330,000 pixels; Student's t with 3 degrees of freedom by most likelihood, then scaled until 68 % lie within one
# standard deviation). Given these a match's own information says nothing more.
RELIEF_SHARE = 2.8  # of the square of the relief about the pixel
APART_SHARE = 0.9  # of the mean square distance to the other views' surfaces, brought onto the ray
PIXEL_SHARE = 0.56  # of a pixel's square on the surface, brought onto the ray, by the square of the views that agree


def depth_maps(crops: Sequence[Crop], stack: Stack, fields: Sequence[Field]) -> tuple[DepthMap, ...]:
    """Compares the full-size fields of all views with each other. Returns a depth map for each view with only those
    pixels whose surface point other views confirm."""
    matched = np.concatenate([(1.0 / np.sqrt(field.information + 1e-6)).ravel() for field in fields])
    depth = np.concatenate([field.depth.ravel() for field in fields])
    slopes = np.concatenate([field.slopes.reshape(-1, 2) for field in fields])

    def work(view: int) -> DepthMap:
        others = np.array([k for k in range(len(crops)) if k != view], dtype=np.int64)
        shape = fields[view].depth.shape
        agreeing, before = np.empty(shape, np.uint8), np.empty(shape, np.uint8)
        apart = np.empty(shape, np.float32)
        count_agreeing(
            int(stack.offset[view]), stack.homographies(view, others), stack.lens[others, :2].copy(), matched, depth,
            slopes, (AGREE_MM, AGREE_DEVIATIONS), agreeing, before, apart,
        )  # fmt: skip
        deviation = stated_deviation(crops[view].camera, fields[view], agreeing, apart)
        clear = (deviation < MAX_DEVIATION_MM) & (stack.image(matched, view) < MAX_DEVIATION_MM)
        inside = stack.image(stack.distance_px, view) < -OUTLINE_PX
        known = inside & clear & (agreeing >= 1) & (MAX_CONTRADICTING_VIEWS * agreeing >= before)
        return _depth_map(crops[view], fields[view], known, deviation, agreeing)

    return tuple(map_in_threads(work, len(crops)))


def stated_deviation(
    camera: Camera, field: Field, agreeing: UInt8[np.ndarray, "h w"], apart: Float32[np.ndarray, "h w"]
) -> Float32[np.ndarray, "h w"]:
    """Returns the standard deviation (mm) of the depth at each pixel, along the ray.

    Args:
        camera: of the view.
        field: depths of the view.
        agreeing: how many other views have the surface at the same point.
        apart: mean squared distance to their surfaces, mm^2.
    """
    k = camera.intrinsics
    pixel_mm = np.maximum(field.depth, 1.0) / k.fx
    slant = 1.0 + (field.slopes[:, :, 0] / pixel_mm) ** 2 + (field.slopes[:, :, 1] / pixel_mm) ** 2  # squared secant
    pixel = PIXEL_SHARE * pixel_mm**2 / np.maximum(agreeing.astype(np.float32), 1.0) ** 2
    variance = RELIEF_SHARE * field.relief_mm**2 + slant * (APART_SHARE * apart + pixel)
    return np.sqrt(variance).astype(np.float32)


def _depth_map(
    crop: Crop,
    field: Field,
    known: Bool[np.ndarray, "h w"],
    deviation: Float32[np.ndarray, "h w"],
    agreeing: UInt8[np.ndarray, "h w"],
) -> DepthMap:
    zero = np.float32(0.0)
    return DepthMap(
        camera=crop.camera,
        depth_mm=np.where(known, field.depth, zero),
        normal=normals_of_known(field.depth, field.slopes, known, *placing(crop.camera)[:2]),
        deviation_mm=np.where(known, deviation, np.float32(np.inf)),
        views=np.where(known, agreeing + 1, 0).astype(np.uint8),
    )
