"""Computes the extent of the visual hull: a cube that contains the subject in all silhouettes."""

from collections.abc import Mapping

import numpy as np
from jaxtyping import Bool, Float

from pipeline.imaging.silhouette import Silhouette
from rig.camera import Camera
from rig.geometry import nearest_to_rays
from rig.rig import Rig

Vector = Float[np.ndarray, " 3"]


def hull_extent(silhouettes: Mapping[str, Silhouette], rig: Rig) -> tuple[Vector, float]:
    """Returns the centre (world frame, mm) and edge length (mm) of a cube that contains the subject, from the usable
    silhouettes."""
    return mask_extent({camera.name: silhouettes[camera.name].mask for camera in usable_cameras(silhouettes, rig)}, rig)


def mask_extent(masks: Mapping[str, Bool[np.ndarray, "_ _"]], rig: Rig) -> tuple[Vector, float]:
    """Returns the centre (world frame, mm) and edge length (mm) of a cube that contains the masked object. Masks may
    have a lower resolution than the images.

    The cube's centre is the point nearest to the rays through the masks' centres; its edge is the largest diagonal of a
    mask at that depth. Without any mask, the cube's centre is the point at which the cameras are directed, and the edge
    is 400 mm."""
    views, rays = [], []
    for name, mask in masks.items():
        camera = rig[name]
        rows, columns = np.flatnonzero(mask.any(axis=1)), np.flatnonzero(mask.any(axis=0))
        scale = camera.intrinsics.width / mask.shape[1]
        middle = np.array([[(columns[0] + columns[-1]) / 2, (rows[0] + rows[-1]) / 2]])
        rays.append(camera.rays_world((middle + 0.5) * scale - 0.5)[0])
        views.append((camera, scale * np.hypot(np.ptp(rows), np.ptp(columns))))
    if not views:
        return rig.centre_world(), 400.0
    centre = nearest_to_rays(np.stack([camera.centre_world for camera, _ in views]), np.stack(rays))
    return centre, float(max(diagonal * depth_of(camera, centre) / camera.intrinsics.fx for camera, diagonal in views))


def depth_of(camera: Camera, point: Vector) -> float:
    """Returns the depth (mm) of a point along the camera's z axis, at least 1 mm."""
    return max(1.0, float(camera.camera_from_world.apply(point)[2]))


def usable_cameras(silhouettes: Mapping[str, Silhouette], rig: Rig) -> list[Camera]:
    """Returns the cameras whose silhouettes are usable and not empty."""
    return [
        c
        for c in rig
        if c.name in silhouettes and silhouettes[c.name].quality.usable and silhouettes[c.name].mask.any()
    ]
