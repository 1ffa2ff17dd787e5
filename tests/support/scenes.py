"""Small scenes whose truth is known without the code under test: a coloured ellipsoid in front of a fan of cameras."""

import numpy as np
import trimesh

from rig.camera import Camera, Distortion, Intrinsics
from rig.geometry import look_at
from rig.mesh import Mesh
from rig.rig import Rig

SEMI_AXES = np.array([75.0, 115.0, 95.0])  # a head's size, mm
LENS = Distortion(k1=-0.06, k2=0.01, p1=3e-4, p2=-2e-4)


def ellipsoid(subdivisions: int = 5) -> Mesh:
    """10,242 vertices at five subdivisions; edges of about 4 mm."""
    sphere = trimesh.creation.icosphere(subdivisions)
    return Mesh(np.asarray(sphere.vertices) * SEMI_AXES, np.asarray(sphere.faces, np.int32))


def pattern(points: np.ndarray) -> np.ndarray:
    """Linear colours (V, 3) in 0.1 to 0.7 that vary smoothly over the surface, 30 mm and more a period."""
    waves = np.stack([np.sin(points @ k / 9.0) for k in ([1.0, 0.5, 0.3], [-0.4, 1.0, 0.2], [0.3, -0.6, 1.0])], axis=1)
    return 0.4 + 0.3 * waves


def fan(width: int = 320, height: int = 240, azimuths_deg: tuple[float, ...] = (-75, -50, -25, 0, 25, 50, 75)) -> Rig:
    """Cameras 1.2 m from the origin, alternately 15 degrees above and below, with distorting lenses."""
    cameras = []
    for i, azimuth in enumerate(np.radians(azimuths_deg)):
        elevation = np.radians(15.0 * (-1) ** i)
        direction = (np.sin(azimuth) * np.cos(elevation), np.sin(elevation), np.cos(azimuth) * np.cos(elevation))
        eye = 1200.0 * np.array(direction)
        focal = 2.9 * height
        lens = Intrinsics(width, height, focal, focal * 1.002, width / 2 + 3.0, height / 2 - 2.0, LENS)
        cameras.append(Camera(f"cam{i:02}", lens, look_at(eye, np.zeros(3), np.array([0.0, 1.0, 0.0]))))
    return Rig(tuple(cameras))


def pixel_grid(camera: Camera) -> np.ndarray:
    """Pixel centres (H * W, 2), row by row."""
    k = camera.intrinsics
    return np.stack(np.meshgrid(np.arange(k.width), np.arange(k.height)), axis=-1).reshape(-1, 2).astype(float)


def ray_ellipsoid(camera: Camera, pixels: np.ndarray) -> np.ndarray:
    """Camera z (mm) of the first hit of each pixel's ray with the ellipsoid, inf where it misses: a closed form, so an
    oracle for anything that draws the mesh."""
    rays, eye = camera.rays_world(pixels) / SEMI_AXES, camera.centre_world / SEMI_AXES
    a, b, c = (rays * rays).sum(1), rays @ eye, eye @ eye - 1.0
    root = b * b - a * c
    with np.errstate(invalid="ignore"):
        along = (-b - np.sqrt(root)) / a
    points = camera.centre_world + along[:, None] * camera.rays_world(pixels)
    return np.where(root > 0, camera.camera_from_world.apply(points)[:, 2], np.inf)
