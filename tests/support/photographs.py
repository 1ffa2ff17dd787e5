"""Photographs of the scenes' ellipsoid by ray tracing in closed form, with the truth of every vertex."""

from collections.abc import Mapping
from dataclasses import dataclass
from functools import lru_cache

import cv2
import numpy as np

from pipeline.imaging.silhouette import Silhouette, silhouette_from_mask
from rig.camera import Camera
from rig.capture import Capture
from rig.colour_space import srgb_from_linear
from rig.mesh import Mesh
from rig.rig import Rig
from tests.support.scenes import SEMI_AXES, ellipsoid, fan, pattern, pixel_grid, ray_ellipsoid

SCREEN = (0.02, 0.75, 0.05)  # linear; a backdrop that no part of the subject resembles


@dataclass(frozen=True)
class Shot:
    mesh: Mesh
    rig: Rig
    capture: Capture
    silhouettes: Mapping[str, Silhouette]
    truth: np.ndarray  # sRGB codes of every vertex, as a camera of gain one sees it


def shoot(
    gains: np.ndarray | None = None,
    *,
    noise: float = 0.015,
    gloss: float = 0.0,
    blur_px: float = 0.7,
    width: int = 640,
    height: int = 480,
) -> Shot:
    """``gains``: (K, 3) exposure of each camera and channel. ``gloss``: strength of a highlight that moves with the
    camera."""
    rig, mesh = fan(width, height), ellipsoid()
    rng = np.random.default_rng(4)
    gains = np.ones((len(rig), 3)) if gains is None else gains
    images, silhouettes = {}, {}
    for (linear, mask), camera, gain in zip(traced(width, height, gloss), rig, gains, strict=True):
        light = cv2.GaussianBlur(linear * gain, (0, 0), blur_px)
        codes = srgb_from_linear(light) + rng.normal(0, noise, light.shape)
        images[camera.name] = np.clip(np.rint(255 * codes), 0, 255).astype(np.uint8)
        silhouettes[camera.name] = silhouette_from_mask(mask)
    truth = np.rint(255 * srgb_from_linear(pattern(mesh.vertices)))
    return Shot(mesh, rig, Capture(images), silhouettes, truth)


@lru_cache(maxsize=2)  # 60 MB; several tests ask for the same scene
def traced(width: int, height: int, gloss: float) -> list[tuple[np.ndarray, np.ndarray]]:
    """``trace`` of every camera, which nobody may write into."""
    found = [trace(camera, gloss) for camera in fan(width, height)]
    for array in (array for pair in found for array in pair):
        array.setflags(write=False)
    return found


def hits(camera: Camera, lamp: np.ndarray) -> tuple[np.ndarray, np.ndarray, np.ndarray, np.ndarray]:
    """Which pixels' rays meet the ellipsoid; there its points (mm), its normals, and the highlight (0 to 1) of a lamp
    in the direction ``lamp``."""
    pixels = pixel_grid(camera)
    depth = ray_ellipsoid(camera, pixels)
    hit = np.isfinite(depth)
    rays = camera.rays_world(pixels[hit])
    points = camera.centre_world + rays * (depth[hit] / (rays @ camera.axis_world))[:, None]
    normals = points / SEMI_AXES**2
    normals /= np.linalg.norm(normals, axis=1, keepdims=True)
    half = lamp - rays
    half /= np.linalg.norm(half, axis=1, keepdims=True)
    return hit, points, normals, np.clip((normals * half).sum(1), 0, 1) ** 120


def trace(camera: Camera, gloss: float) -> tuple[np.ndarray, np.ndarray]:
    """Linear light (H, W, 3) and mask."""
    k = camera.intrinsics
    hit, points, _, mirrored = hits(camera, np.array([0.3, 0.5, 0.81]))
    light = np.tile(np.array(SCREEN), (len(hit), 1))
    light[hit] = pattern(points) + gloss * mirrored[:, None]
    return light.reshape(k.height, k.width, 3), hit.reshape(k.height, k.width)
