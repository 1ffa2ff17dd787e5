"""What one photograph, matched with its neighbours, says of the surface: depth, normal and how far to trust them."""

from dataclasses import dataclass

import numpy as np
from jaxtyping import Bool, Float, Float32, UInt8

from pipeline.stereo.depth_map_kernels import place_known
from rig.camera import Camera


@dataclass(frozen=True, slots=True, eq=False)
class Field:
    """Holds one view's current estimate of the surface: at each pixel the depth (mm along the camera's z axis, 0 where
    there is no surface) and its slopes (mm per pixel, by x and y)."""

    depth: Float32[np.ndarray, "h w"]
    slopes: Float32[np.ndarray, "h w 2"]
    information: Float32[np.ndarray, "h w"]  # 1 / mm^2 of the depth
    relief_mm: Float32[np.ndarray, "h w"]  # RMS of the depths about a pixel from the plane through them
    likeness: Float32[np.ndarray, "h w"]  # mean correlation of the views that show the place alike; 0: none


@dataclass(frozen=True, slots=True, eq=False)
class DepthMap:
    """Holds the surface that one camera sees, on the pixels of a pinhole crop about the subject.

    ``camera`` has no distortion; its name and pose are those of the rig's camera. A pixel is known where its deviation
    is finite; elsewhere depth, normal and ``views`` are 0.
    """

    camera: Camera
    depth_mm: Float32[np.ndarray, "h w"]  # z in the camera frame
    normal: Float32[np.ndarray, "h w 3"]  # unit, world frame, towards the camera
    deviation_mm: Float32[np.ndarray, "h w"]  # standard deviation along the ray; inf where nothing is known
    views: UInt8[np.ndarray, "h w"]  # that agree on the place, this one counted

    @property
    def known(self) -> Bool[np.ndarray, "h w"]:
        """Tells which pixels have a known depth."""
        return np.isfinite(self.deviation_mm)


def points_world(depth_map: DepthMap) -> Float[np.ndarray, "n 3"]:
    """Returns the surface points (world frame, mm) of the known pixels, row by row."""
    pinhole, turn, shift = placing(depth_map.camera)
    return place_known(depth_map.depth_mm, depth_map.deviation_mm, pinhole, turn, shift)


def placing(camera: Camera) -> tuple[Float[np.ndarray, " 4"], Float[np.ndarray, "3 3"], Float[np.ndarray, " 3"]]:
    """Returns what ``depth_map_kernels`` need of a camera without distortion: fx fy cx cy (px), and rotation and
    translation (mm) of world_from_camera."""
    k, pose = camera.intrinsics, camera.camera_from_world.inverse()
    turn, shift = (np.ascontiguousarray(each, float) for each in (pose.rotation, pose.translation))
    return np.array([k.fx, k.fy, k.cx, k.cy]), turn, shift
