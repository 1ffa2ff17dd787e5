"""A texture image for the head: the photographs' own resolution, where a colour a vertex keeps a point each 2 mm.

Every texel of the model's layout (``pipeline.texture.uv_unwrap``) is a point of the fitted surface and takes its colour
as a vertex does (section 4.5, ``pipeline.texture.vertex_colours``): the same visibility, margins, camera gains and
highlights. What no camera sees is filled with the colours that the vertices were given.
"""

from collections.abc import Mapping
from concurrent.futures import ThreadPoolExecutor

import cv2
import numpy as np
from jaxtyping import Float, Float32, Int32, UInt8

from pipeline.imaging.cpu_raster import camera_depths
from pipeline.imaging.cpu_raster_kernels import interpolate, rasterise
from pipeline.imaging.silhouette import Silhouette
from pipeline.parallel_for import thread_count
from pipeline.settings import TextureSettings
from pipeline.texture.uv_unwrap import Atlas, Layout
from pipeline.texture.vertex_colours import Texture, blend, usable_views
from pipeline.texture.visibility import see_points, sharpened
from rig.capture import Capture
from rig.colour_space import linear_from_srgb, srgb_from_linear
from rig.mesh import Mesh
from rig.rig import Rig

SIZES = (1024, 2048, 4096)
FINER = 0.75  # texel by pixel on the head: coarser ones would lose detail
BLOCK_ROWS = 64  # painted at once: 6 MB a camera at the largest size


def paint_atlas(
    layout: Layout,
    mesh_world: Mesh,
    normals: Float[np.ndarray, "v 3"],
    coloured: Texture,
    capture: Capture,
    silhouettes: Mapping[str, Silhouette],
    rig: Rig,
    depths: Mapping[str, Float32[np.ndarray, "_ _"]],
    settings: TextureSettings,
) -> Atlas:
    """The image of a head that ``coloured`` holds the vertex colours and camera gains of."""
    views = usable_views(capture, silhouettes, rig)
    size = _size(layout, mesh_world, views)
    images = {name: sharpened(capture.images[name], silhouettes[name].mask, settings) for name in views.names}
    gains = np.array([coloured.gains.get(name, (1.0, 1.0, 1.0)) for name in views.names])
    offsets = np.array([coloured.offsets.get(name, (0.0, 0.0, 0.0)) for name in views.names])
    texels = size * layout.uv - 0.5
    _, shown = rasterise(texels, np.ones(len(texels)), layout.faces, size, size)
    known = linear_from_srgb(coloured.colours / 255.0)
    surface = np.concatenate([mesh_world.vertices, normals, known], axis=1)[layout.source].astype(np.float32)
    image = np.zeros((size, size, 3), np.uint8)

    def paint(row: int) -> None:
        faces = shown[row : row + BLOCK_ROWS]
        values = interpolate(faces, texels - (0, row), np.ones(len(texels)), layout.faces, surface)[faces >= 0]
        linear = values[:, 6:].astype(float)
        if len(views) and len(values):
            points, across = values[:, :3].astype(float), values[:, 3:6].astype(float)
            sights = [
                see_points(
                    camera, images[camera.name], silhouettes[camera.name], depths[camera.name], points, across,
                    settings,
                )
                for camera in views
            ]  # fmt: skip
            found, count = blend(sights, gains, offsets, settings.highlight)
            linear = np.where(count[:, None] > 0, found, linear)
        image[row : row + BLOCK_ROWS][faces >= 0] = np.rint(255 * srgb_from_linear(linear))

    with ThreadPoolExecutor(thread_count()) as pool:  # the compiled kernels release the interpreter lock
        list(pool.map(paint, range(0, size, BLOCK_ROWS)))
    return Atlas(layout, _padded(image, shown))


def _size(layout: Layout, mesh_world: Mesh, views: Rig) -> int:
    """Side of the image (texels): no texel is coarser than a pixel on the head, in the median over the surface."""
    sides = np.roll(layout.faces, -1, axis=1)
    length_mm = np.linalg.norm(
        mesh_world.vertices[layout.source[layout.faces]] - mesh_world.vertices[layout.source[sides]], axis=2
    )
    unit_mm = float(np.median(length_mm / np.linalg.norm(layout.uv[layout.faces] - layout.uv[sides], axis=2)))
    centre = mesh_world.vertices.mean(axis=0, keepdims=True)
    pixel_mm = [float(camera_depths(camera, centre)[0]) / camera.intrinsics.fx for camera in views]
    wanted = unit_mm / (FINER * min(pixel_mm, default=1.0))
    return next((size for size in SIZES if size >= wanted), SIZES[-1])


def _padded(image: UInt8[np.ndarray, "s s 3"], shown: Int32[np.ndarray, "s s"]) -> UInt8[np.ndarray, "s s 3"]:
    """The colour of the nearest painted texel in those that no triangle covers, so that nothing foreign bleeds in at
    the cut."""
    empty = (shown < 0).view(np.uint8)
    _, labels = cv2.distanceTransformWithLabels(empty, cv2.DIST_L2, cv2.DIST_MASK_5, labelType=cv2.DIST_LABEL_PIXEL)
    nearest = np.asarray(labels).astype(np.int32)
    colours = np.zeros((int(nearest.max()) + 1, 3), np.uint8)
    colours[nearest[shown >= 0]] = image[shown >= 0]
    return colours[nearest]
