"""Packs the images of all cameras as tiles into few textures (pages), and prepares camera parameters for shaders."""

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from jaxtyping import Float, Int

from rig.camera import Camera
from rig.errors import EigenheadError
from rig.messages.message import compose

BLOCK_PX = 8  # tiles begin and end on multiples of this, so that a block of the reduction lies in one tile
PAGE_PX = 8192  # a page's longest side where the driver would allow more: 64 MB of mask
NEAR_MM = 1.0
INSTANCE_FORMAT = "4f 4f 4f 4f 4f 4f 4f 2f/i"
INSTANCE_NAMES = ("pose_x", "pose_y", "pose_z", "projection", "lens", "lens_more", "tile", "depth_range")


class ImageTooLarge(EigenheadError):
    """Reports that an image is larger than OpenGL's largest texture."""

    def __init__(self, name: str, width: int, height: int, limit: int) -> None:
        super().__init__(compose("image-beyond-driver", camera=name, width=width, height=height, most=limit))


@dataclass(frozen=True, slots=True, eq=False)
class Page:
    """Describes a texture that several cameras share: the cameras' indices and tiles (left, top, width, height, px)."""

    width: int
    height: int
    cameras: tuple[int, ...]
    tiles: Int[np.ndarray, "k 4"]

    def cut(self, image: np.ndarray, position: int) -> np.ndarray:
        """Returns the tile with index ``position`` from an image of the whole page."""
        left, top, width, height = self.tiles[position]
        return image[top : top + height, left : left + width]


def pack(cameras: Sequence[Camera], largest_side: int) -> tuple[Page, ...]:
    """Packs the cameras' images in rows onto pages, the tallest images first. Raises ImageTooLarge."""
    side = min(largest_side, PAGE_PX)
    for camera in cameras:
        k = camera.intrinsics
        if max(k.width, k.height) > side - BLOCK_PX:
            side = largest_side
        if max(k.width, k.height) > largest_side - BLOCK_PX:
            raise ImageTooLarge(camera.name, k.width, k.height, largest_side - BLOCK_PX)
    area = sum(_padded(c.intrinsics.width) * _padded(c.intrinsics.height) for c in cameras)
    widest = max(_padded(c.intrinsics.width) for c in cameras)
    row_px = min(side, max(widest, _padded(int(1.2 * area**0.5))))  # pages a little wider than high
    order = sorted(range(len(cameras)), key=lambda i: -cameras[i].intrinsics.height)
    pages, placed, x, y, shelf = [], [], 0, 0, 0
    for index in order:
        width, height = cameras[index].intrinsics.width, cameras[index].intrinsics.height
        if x + _padded(width) > row_px:
            x, y, shelf = 0, y + shelf, 0
        if y + _padded(height) > side:
            pages.append(_page(placed))
            placed, x, y, shelf = [], 0, 0, 0
        placed.append((index, (x, y, width, height)))
        x, shelf = x + _padded(width), max(shelf, _padded(height))
    return (*pages, _page(placed))


def _padded(pixels: int) -> int:
    return -(-pixels // BLOCK_PX) * BLOCK_PX


def _page(placed: list[tuple[int, tuple[int, int, int, int]]]) -> Page:
    tiles = np.array([tile for _, tile in placed])
    width, height = (tiles[:, :2] + tiles[:, 2:]).max(axis=0)
    return Page(_padded(int(width)), _padded(int(height)), tuple(index for index, _ in placed), tiles)


def lens_limit(camera: Camera) -> float:
    """Returns the radius, in units of ``X / Z``, beyond which no point is drawn. The returned radius is twice the
    radius of the image's farthest corner."""
    k = camera.intrinsics
    corners = np.array([(x, y) for x in (-0.5, k.width - 0.5) for y in (-0.5, k.height - 0.5)])
    radii = np.linalg.norm(camera.undistort(corners), axis=1)
    radii = radii[np.isfinite(radii)]
    farthest = 2.0 * radii.max() if len(radii) == 4 else np.inf
    return float(min(farthest, k.distortion.max_valid_radius(), 1e3))


def instances(
    cameras: Sequence[Camera],
    page: Page,
    origin_world: Float[np.ndarray, " 3"],
    depth_ranges: Float[np.ndarray, "n 2"] | None = None,
) -> Float[np.ndarray, "k 30"]:
    """Returns a row of shader inputs for each tile of ``page``. Vertices for the shader must be relative to
    ``origin_world`` (mm).

    ``depth_ranges`` holds the nearest and farthest depth (mm) of the scene in each camera. None draws without a depth
    buffer.
    """
    rows = np.zeros((len(page.cameras), 30), np.float32)
    for row, index, tile in zip(rows, page.cameras, page.tiles, strict=True):
        camera = cameras[index]
        pose = camera.camera_from_world
        row[:12] = np.column_stack([pose.rotation, pose.apply(origin_world)]).ravel()
        row[12:21] = camera.intrinsics.values()
        row[21:24] = min(camera.intrinsics.distortion.max_valid_radius(), 1e6), lens_limit(camera), NEAR_MM
        row[24:28] = tile
        if depth_ranges is not None:
            near, far = depth_ranges[index]
            row[28:30] = (far + near) / (far - near), -2 * far * near / (far - near)
    return rows


def box_points(vertices: Float[np.ndarray, "v 3"], per_edge: int = 9) -> Float[np.ndarray, "p 3"]:
    """Returns points on the twelve edges of the vertices' bounding box. In a view from outside the box, the points'
    outline encloses the mesh."""
    low, high = vertices.min(axis=0), vertices.max(axis=0)
    steps = np.linspace(0.0, 1.0, per_edge)
    corners = np.array([(a, b) for a in (0.0, 1.0) for b in (0.0, 1.0)])
    edges = [np.insert(np.repeat(corners, per_edge, 0), axis, np.tile(steps, 4), axis=1) for axis in range(3)]
    return low + np.concatenate(edges) * (high - low)


def depth_range(camera: Camera, box: Float[np.ndarray, "p 3"]) -> tuple[float, float]:
    """Returns the nearest and the farthest depth (mm) of a bounding box's points in a camera, slightly widened."""
    depth = camera.camera_from_world.apply(box)[:, 2]
    near = max(0.99 * float(depth.min()), NEAR_MM)
    return near, max(1.01 * float(depth.max()), near + 1.0)
