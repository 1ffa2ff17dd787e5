"""Defines the depth map of one view: depth, normal and standard deviation at each pixel.

Window matching has a bias. The whole surface lies a little too deep, and curved parts come out too flat: protruding
parts (bridge of the nose, lips) are cut off, and hollows are filled. To first order the flattening is ``share`` times
the height of the surface's mean in a 2.5 mm window above the surface. ``pipeline.detail.depth_bias`` measures depth
error and flattening on each capture.
"""

from dataclasses import dataclass

import numpy as np
from jaxtyping import Bool, Float, Float32, UInt8

from pipeline.compute.threads import in_threads
from pipeline.geometry.nearest import sorted_into_cells
from pipeline.stereo.depth_map_kernels import place_known, windowed_heights
from rig.camera import Camera
from rig.mesh import Mesh

WINDOW_MM, REACH_MM = 2.5, 6.25  # standard deviation of the window, and where it ends


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
    """Holds the depth map of one camera, on the pixels of a pinhole crop around the subject.

    ``camera`` has no distortion; its name and pose are those of the rig's camera. The depth of a pixel is known if its
    standard deviation is finite; otherwise depth, normal and ``views`` are 0.
    """

    camera: Camera
    depth_mm: Float32[np.ndarray, "h w"]  # z in the camera frame
    normal: Float32[np.ndarray, "h w 3"]  # unit, world frame, towards the camera
    deviation_mm: Float32[np.ndarray, "h w"]  # standard deviation along the ray; inf where nothing is known
    views: UInt8[np.ndarray, "h w"]  # that agree on the place, this one counted

    @property
    def known(self) -> Bool[np.ndarray, "h w"]:
        """Returns a mask of the pixels with a known depth."""
        return np.isfinite(self.deviation_mm)


def points_world(depth_map: DepthMap) -> Float[np.ndarray, "n 3"]:
    """Returns the surface points (world frame, mm) of the pixels with known depth, row by row."""
    pinhole, turn, shift = placing(depth_map.camera)
    return place_known(depth_map.depth_mm, depth_map.deviation_mm, pinhole, turn, shift)


def placing(camera: Camera) -> tuple[Float[np.ndarray, " 4"], Float[np.ndarray, "3 3"], Float[np.ndarray, " 3"]]:
    """Packs a camera without distortion for ``depth_map_kernels``: fx fy cx cy (px), and rotation and translation (mm)
    of world_from_camera."""
    k, pose = camera.intrinsics, camera.camera_from_world.inverse()
    turn, shift = (np.ascontiguousarray(each, float) for each in (pose.rotation, pose.translation))
    return np.array([k.fx, k.fy, k.cx, k.cy]), turn, shift


@dataclass(frozen=True, slots=True)
class WindowBias:
    """Holds the bias of window matching along the surface normal: ``common_mm`` everywhere, plus ``share`` times
    ``windowed_height``."""

    common_mm: float = 0.0
    share: float = 0.0


def windowed_height(
    vertices: Float[np.ndarray, "v 3"], normals: Float[np.ndarray, "v 3"], wanted: Bool[np.ndarray, " v"] | None = None
) -> Float[np.ndarray, " v"]:
    """Computes the height (mm, along the normal) of the surface's mean in a window above each vertex. Parts of the
    window with an opposite normal do not count. Vertices outside ``wanted`` get 0; None means all vertices."""
    order, keys, spans = sorted_into_cells(vertices, REACH_MM)
    chosen = np.ones(len(vertices), bool) if wanted is None else wanted[order]
    surface = np.concatenate([(vertices - vertices.min(axis=0)).T, normals.T])[:, order].astype(np.float32, order="C")
    sorted_mm, height_mm = np.zeros(len(vertices), np.float32), np.empty(len(vertices))

    def fill(first: int, last: int) -> None:
        windowed_heights(surface, chosen, keys, spans, WINDOW_MM, REACH_MM, sorted_mm, first, last)

    in_threads(len(vertices), fill)
    height_mm[order] = sorted_mm
    return height_mm


def subtract_bias(mesh_world: Mesh, measured: Bool[np.ndarray, " v"], bias: WindowBias) -> Mesh:
    """Subtracts the bias of window matching from the mesh's measured vertices, along their normals."""
    if bias == WindowBias():
        return mesh_world
    vertices, normals = mesh_world.vertices, mesh_world.normals()
    off_mm = bias.common_mm + bias.share * windowed_height(vertices, normals, measured)
    return Mesh(vertices - np.where(measured, off_mm, 0.0)[:, None] * normals, mesh_world.faces)
