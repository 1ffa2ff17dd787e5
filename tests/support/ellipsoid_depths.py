"""Depth maps of ellipsoids in closed form, with planted noise: what the fusion is tested on."""

from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np

from pipeline.imaging.silhouette import Silhouette, silhouette_from_mask
from pipeline.stereo.depth_map import DepthMap
from rig.camera import Camera, Distortion
from rig.rig import Rig
from tests.support.scenes import fan, pixel_grid

Place = tuple[float, float, float]
NOISE_MM = 0.2
FLATTEST = 0.25  # cosine: at a flatter angle nothing is known, as with photographs


@dataclass(frozen=True)
class Ellipsoid:
    centre: Place
    axes: Place

    def hit(self, eye: np.ndarray, rays: np.ndarray) -> np.ndarray:
        """Distance along each ray to the first point, inf where it misses."""
        unit, start = rays / self.axes, (eye - self.centre) / np.array(self.axes)
        a, b, c = (unit * unit).sum(1), unit @ start, start @ start - 1.0
        root = b * b - a * c
        return np.where(root > 0, (-b - np.sqrt(np.maximum(root, 0))) / a, np.inf)

    def normals(self, points: np.ndarray) -> np.ndarray:
        gradient = (points - self.centre) / np.array(self.axes) ** 2
        return gradient / np.linalg.norm(gradient, axis=1, keepdims=True)

    def distance(self, points: np.ndarray) -> np.ndarray:
        """Signed, to first order: exact at the surface."""
        place = (points - self.centre) / np.array(self.axes)
        gradient = 2 * place / np.array(self.axes)
        return ((place * place).sum(1) - 1) / np.linalg.norm(gradient, axis=1)


@dataclass(frozen=True)
class Scene:
    bodies: tuple[Ellipsoid, ...]
    rig: Rig
    maps: tuple[DepthMap, ...]
    silhouettes: dict[str, Silhouette]

    def distance(self, points: np.ndarray) -> np.ndarray:
        return np.min([body.distance(points) for body in self.bodies], axis=0)


def pinhole_fan() -> Rig:
    return Rig(tuple(pinhole(camera) for camera in fan(400, 300)))


def pinhole(camera: Camera) -> Camera:
    """The camera without its lens's distortion."""
    k = camera.intrinsics
    return replace(camera, intrinsics=replace(k, distortion=Distortion()))


def look(camera: Camera, bodies: Sequence[Ellipsoid]) -> tuple[np.ndarray, np.ndarray]:
    """Camera z (inf where nothing) and world normals at every pixel."""
    k = camera.intrinsics
    rays = camera.rays_world(pixel_grid(camera))
    hits = np.stack([body.hit(camera.centre_world, rays) for body in bodies])
    which, along = hits.argmin(axis=0), hits.min(axis=0)
    points = camera.centre_world + np.where(np.isfinite(along), along, 0.0)[:, None] * rays
    normals = np.stack([body.normals(points) for body in bodies])[which, np.arange(len(rays))]
    depth = np.where(np.isfinite(along), camera.camera_from_world.apply(points)[:, 2], np.inf)
    return depth.reshape(k.height, k.width), normals.reshape(k.height, k.width, 3)


def known_depth(camera: Camera, bodies: Sequence[Ellipsoid], noise_mm: float, rng: np.random.Generator) -> DepthMap:
    """What an ideal stage would say of a view: noise of ``noise_mm``, as stated; nothing at grazing angles."""
    flat = pinhole(camera)
    depth, normals = look(flat, bodies)
    rays = flat.rays_world(pixel_grid(flat)).reshape(normals.shape)
    known = np.isfinite(depth) & (-(normals * rays).sum(2) > FLATTEST)
    noisy = np.where(np.isfinite(depth), depth, 0.0) + rng.normal(0, noise_mm, depth.shape)
    return DepthMap(
        flat,
        np.where(known, noisy, 0).astype(np.float32),
        np.where(known[..., None], normals, 0).astype(np.float32),
        np.where(known, max(noise_mm, 0.05), np.inf).astype(np.float32),
        np.where(known, 3, 0).astype(np.uint8),
    )


def scene(
    bodies: Sequence[Ellipsoid], rig: Rig | None = None, noise_mm: float = NOISE_MM, true_rig: Rig | None = None
) -> Scene:
    """Seen by a fan of pinhole cameras, if no rig is given; ``true_rig`` takes the pictures where it differs."""
    rig = rig or pinhole_fan()
    rng = np.random.default_rng(5)
    maps, silhouettes = [], {}
    for recorded, camera in zip(rig, true_rig or rig, strict=True):
        maps.append(replace(known_depth(camera, bodies, noise_mm, rng), camera=pinhole(recorded)))
        silhouettes[recorded.name] = silhouette_from_mask(np.isfinite(look(camera, bodies)[0]))
    return Scene(tuple(bodies), rig, tuple(maps), silhouettes)
