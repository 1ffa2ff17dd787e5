"""A textured ball, and what may stand before it, ray-cast with numpy alone: it shares no code with what it tests."""

from dataclasses import dataclass

import numpy as np

from pipeline.imaging.silhouette import Silhouette, silhouette_from_mask
from rig.camera import Camera, Distortion, Intrinsics
from rig.geometry import look_at
from rig.rig import Rig

WIDTH, HEIGHT, FOCAL_PX, AWAY_MM = 216, 184, 620.0, 700.0


@dataclass(frozen=True, slots=True, eq=False)
class Ball:
    """Centre and radius, mm; ``contrast`` of its texture in grey levels, whose waves are ``wave_mm`` long."""

    centre: tuple[float, float, float] = (0.0, 0.0, 0.0)
    radius: float = 80.0
    contrast: float = 30.0
    wave_mm: float = 9.0


def fan(count: int, step_deg: float, distortion: Distortion | None = None) -> Rig:
    """Cameras on an arc about the z axis of the world, looking at the origin."""
    cameras = []
    for i in range(count):
        angle = np.radians(step_deg * (i - (count - 1) / 2))
        centre = AWAY_MM * np.array([np.sin(angle), 0.15 * (-1) ** i, np.cos(angle)])
        pose = look_at(centre, np.zeros(3), np.array([0.0, 1.0, 0.0]))
        lens = distortion or Distortion()
        intrinsics = Intrinsics(WIDTH, HEIGHT, FOCAL_PX, FOCAL_PX * 1.01, WIDTH / 2 + 1.3, HEIGHT / 2 - 0.8, lens)
        cameras.append(Camera(f"cam{i}", intrinsics, pose))
    return Rig(tuple(cameras))


def first_hit(camera: Camera, pixels: np.ndarray, balls: tuple[Ball, ...]) -> tuple[np.ndarray, np.ndarray]:
    """Distance along the unit ray (inf where none) and number of the ball that each pixel sees."""
    origin, rays = camera.centre_world, camera.rays_world(pixels)
    nearest, owner = np.full(len(pixels), np.inf), np.full(len(pixels), -1)
    for number, ball in enumerate(balls):
        offset = origin - np.array(ball.centre)
        along = rays @ offset
        root = along**2 - (offset @ offset - ball.radius**2)
        distance = np.where(root > 0, -along - np.sqrt(np.maximum(root, 0.0)), np.inf)
        closer = distance < nearest
        nearest[closer], owner[closer] = distance[closer], number
    return nearest, owner


def shade(points: np.ndarray, ball: Ball, seed: int) -> np.ndarray:
    """A solid texture of waves in random directions."""
    rng = np.random.default_rng(seed)
    way = rng.normal(size=(40, 3))
    way *= 2 * np.pi / (ball.wave_mm * rng.uniform(0.8, 2.5, 40) * np.linalg.norm(way, axis=1))[:, None]
    return 128.0 + ball.contrast * np.sin(points @ way.T + rng.uniform(0, 6.3, 40)).sum(axis=1) / np.sqrt(20.0)


def shoot(
    rig: Rig, balls: tuple[Ball, ...], noise: float = 1.0, seed: int = 5
) -> tuple[dict[str, np.ndarray], dict[str, Silhouette]]:
    """Photographs (each pixel the mean of nine rays, with noise, gain and offset of its own) and true silhouettes."""
    rng = np.random.default_rng(seed)
    column, row = np.meshgrid(np.arange(WIDTH), np.arange(HEIGHT))
    centres = np.stack([column.ravel(), row.ravel()], axis=1).astype(float)
    images, silhouettes = {}, {}
    for camera in rig:
        light, cover = np.zeros(len(centres)), np.zeros(len(centres))
        for offset in np.ndindex(3, 3):
            pixels = centres + (np.array(offset) - 1.0) / 3.0
            distance, owner = first_hit(camera, pixels, balls)
            points = camera.centre_world + np.minimum(distance, 1e4)[:, None] * camera.rays_world(pixels)
            values = np.full(len(points), 60.0)
            for number, ball in enumerate(balls):
                mine = owner == number
                values[mine] = shade(points[mine], ball, number)
            light += values / 9.0
            cover += (owner >= 0) / 9.0
        gain, offset = rng.uniform(0.95, 1.05), rng.uniform(-3.0, 3.0)
        grey = gain * light + offset + rng.normal(0.0, noise, len(light))
        image = np.clip(np.rint(grey), 0, 255).astype(np.uint8).reshape(HEIGHT, WIDTH)
        images[camera.name] = np.repeat(image[:, :, None], 3, axis=2)
        silhouettes[camera.name] = silhouette_from_mask(cover.reshape(HEIGHT, WIDTH) >= 0.5)
    return images, silhouettes
