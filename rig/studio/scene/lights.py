"""Computes soft light on the subject, with the shadows that the subject casts on itself.

The lamps are soft boxes on a dome. The dome of lamps is sampled in ``DIRECTIONS`` directions. A depth map from each
direction shows which vertices its light reaches. The sum over many directions makes the shadows soft. Irradiance is
computed for each vertex of the subject.
"""

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from jaxtyping import Float, Int

from rig.camera import Camera, Intrinsics, lens_image
from rig.geometry import look_at
from rig.render.renderer import Renderer
from rig.rig import Rig

DIRECTIONS = 24
MAP_PX = 176
LAMP_DISTANCE_MM = 5000.0
BIAS_MM = 3.0  # a surface does not shade itself for the coarseness of the map, 2.5 mm a pixel


@dataclass(frozen=True, slots=True)
class Lamp:
    """Holds a soft box. ``towards`` is the direction from the subject to the lamp (world frame, y up, z to the front),
    ``colour`` is linear RGB, and ``sharpness`` is larger for a smaller box."""

    towards: tuple[float, float, float]
    colour: tuple[float, float, float]
    sharpness: float  # exponent of the cosine about ``towards``


LAMPS = (
    Lamp((-0.45, 0.75, 0.85), (1.25, 1.20, 1.12), 9.0),  # key, above on the subject's right
    Lamp((0.85, 0.35, 0.65), (0.62, 0.64, 0.68), 5.0),  # fill, on the left
    Lamp((0.0, 1.0, -0.25), (0.40, 0.40, 0.42), 5.0),  # top, separates the hair from the backdrop
)
AMBIENT = (0.34, 0.34, 0.35)


def lamp_directions(lamps: Sequence[Lamp] = LAMPS) -> Float[np.ndarray, "l 3"]:
    """Returns the unit directions from the subject to the lamps in the world frame."""
    towards = np.array([lamp.towards for lamp in lamps])
    return towards / np.linalg.norm(towards, axis=1, keepdims=True)


def dome(lamps: Sequence[Lamp] = LAMPS) -> tuple[Float[np.ndarray, "d 3"], Float[np.ndarray, "d 3"]]:
    """Returns directions spread evenly over the sphere above -45 degrees of elevation, and the linear RGB of the light
    from each direction."""
    index = np.arange(DIRECTIONS) + 0.5
    y = 1.0 - index / DIRECTIONS * 1.7
    angle = index * np.pi * (3.0 - np.sqrt(5.0))
    ring = np.sqrt(1.0 - y**2)
    directions = np.stack([ring * np.cos(angle), y, ring * np.sin(angle)], axis=1)
    sent = np.tile(np.array(AMBIENT) / DIRECTIONS * 2.4, (DIRECTIONS, 1))
    for lamp, towards in zip(lamps, lamp_directions(lamps), strict=True):
        lobe = np.maximum(directions @ towards, 0.0) ** lamp.sharpness
        sent += lobe[:, None] / lobe.sum() * np.array(lamp.colour)
    return directions, sent


def irradiance(
    renderer: Renderer,
    receivers: Sequence[tuple[Float[np.ndarray, "_ 3"], Float[np.ndarray, "_ 3"]]],
    casters: tuple[Float[np.ndarray, "v 3"], Int[np.ndarray, "f 3"]],
    lamps: Sequence[Lamp] = LAMPS,
) -> list[Float[np.ndarray, "_ 3"]]:
    """Computes the irradiance (linear RGB) at the vertices of each receiver, which is a pair of vertices and unit
    normals in the world frame. The triangles of ``casters`` cast shadows."""
    directions, sent = dome(lamps)
    vertices, faces = casters
    centre = (vertices.min(axis=0) + vertices.max(axis=0)) / 2
    radius = float(np.linalg.norm(vertices - centre, axis=1).max())
    rig = Rig(tuple(_lamp_camera(i, direction, centre, radius) for i, direction in enumerate(directions)))
    depth = renderer.depth(rig, vertices, faces)
    irradiance = [np.zeros((len(points), 3)) for points, _ in receivers]
    for camera, direction, colour in zip(rig, directions, sent, strict=True):
        image = depth[camera.name]
        for light, (points, normals) in zip(irradiance, receivers, strict=True):
            cosine = normals @ direction
            facing = np.flatnonzero(cosine > 0)
            reached = _reached(camera, image, points[facing] + 1.5 * normals[facing])
            light[facing] += (cosine[facing] * reached)[:, None] * colour
    return irradiance


def _lamp_camera(
    index: int, direction: Float[np.ndarray, " 3"], centre: Float[np.ndarray, " 3"], radius: float
) -> Camera:
    up = np.array([0.0, 0.0, 1.0]) if abs(direction[1]) > 0.9 else np.array([0.0, 1.0, 0.0])
    focal = 0.5 * MAP_PX * LAMP_DISTANCE_MM / (1.05 * radius)
    intrinsics = Intrinsics(MAP_PX, MAP_PX, focal, focal, (MAP_PX - 1) / 2, (MAP_PX - 1) / 2)
    return Camera(f"lamp{index:02}", intrinsics, look_at(centre + LAMP_DISTANCE_MM * direction, centre, up))


def _reached(
    camera: Camera, depth: Float[np.ndarray, "h w"], points: Float[np.ndarray, "n 3"]
) -> Float[np.ndarray, " n"]:
    """Returns the bilinear weight of those of the four nearest depth map pixels that do not hide the point."""
    k = camera.intrinsics
    points_camera = camera.camera_from_world.apply(points)
    x, y = np.clip(lens_image(points_camera, k.values()), 0, (k.width - 1.001, k.height - 1.001)).T
    left, top = x.astype(int), y.astype(int)
    across, down = x - left, y - top
    limit = points_camera[:, 2] - BIAS_MM
    share = np.zeros(len(points))
    for dy, wy in ((0, 1 - down), (1, down)):
        for dx, wx in ((0, 1 - across), (1, across)):
            share += wx * wy * (depth[top + dy, left + dx] > limit)
    return share
