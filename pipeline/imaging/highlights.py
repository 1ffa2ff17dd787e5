"""Removes highlights on skin from photographs before their views are matched with each other.

A highlight moves over the skin when the camera moves. Matched highlights therefore appear behind a convex surface, by
up to half its radius of curvature; smooth skin often shows nothing else that could be matched. Comparing the views at
each point of the fitted head separates the highlight: the light from the skin itself is the same in all views, and a
highlight adds the lamp's colour in a few views. Each view is therefore darkened to the level of the darkest third of
the views, by a correction that varies slowly along the surface. The correction applies only where the excess light is
less coloured than the skin (the dichromatic model: Shafer 1985, *Using color to separate reflection components*; Lin et
al. 2002, *Diffuse-specular separation and depth recovery from image sequences*, compare views in the same way). The
skin's texture is finer than the correction and is not changed. If views differ by light of the skin's colour, the
fitted head is at a wrong position, and nothing is removed. Levels are subtracted in sRGB values instead of linear
light, because a camera's tone curve for highlights is unknown."""

from collections.abc import Mapping
from dataclasses import dataclass

import cv2
import numpy as np
from jaxtyping import Bool, Float, Float32, Int, Int32, UInt8

from pipeline.compute.threads import map_in_threads
from pipeline.compute.trace import traced
from pipeline.geometry.projection import camera_depths, project_points
from pipeline.geometry.projection_kernels import interpolate, rasterise
from pipeline.geometry.surface_index import facing_cosine
from pipeline.imaging.silhouette import Silhouette
from rig.camera import Camera
from rig.mesh import Mesh
from rig.rig import Rig

GAMMA = 2.2
LIGHT = np.array([0.3, 0.5, 0.2], np.float32)
WHITE = np.full(3, 1.0 / np.sqrt(3.0), np.float32)
BLUR_MM = 1.0  # of the colours that are compared: the fitted head is off by as much
SPREAD_MM = 1.5  # over which what is taken off is smoothed: pores and moles stay
LOBE_MM, LOBE_FACTOR = 8.0, 4.0  # a lobe's flanks reach as far from what is sure, and count whole where a quarter of
# what is about them is
MIN_COVERAGE = 0.05  # share of a window whose places are known
MIN_FACING = 0.15  # cosine
HIDDEN_MM = 1.5  # a nearer surface hides a vertex beyond this
OUTLINE_MM = 1.5  # nothing is compared nearer to the outline
MIN_VIEWS = 3  # of a vertex: with two, the shining view is ambiguous
DARKEST_SHARE = 1.0 / 3.0  # of the views, whose mean is the skin's own light
MIN_SHARE = 0.04  # of that light, that a highlight adds at least; it counts whole at twice that. Skin lit evenly and
# photographed by one kind of camera differs by less
COLOURED = (0.02, 0.05)  # squared sine between the skin's colour and white, from which on they can be told apart, and
# are well; skin has 0.1, dark hair 0.04
DARK_SHARE = 0.4  # of the head's usual light: darker places are hair, brows or nostrils, and what is brighter in some
# views is skin beside them
MIN_GAIN_PLACES = 300  # that a camera shares with others, for its gain


@dataclass(frozen=True, slots=True, eq=False)
class _Sight:
    """Holds the head in one camera: the image box that contains it, the pixels and depths (mm) of its vertices, the
    triangle at each pixel, and the vertices' colours (linear; NaN where hidden)."""

    box: tuple[slice, slice]
    pixels: Float[np.ndarray, "v 2"]
    depths: Float[np.ndarray, " v"]
    faces_seen: Int32[np.ndarray, "r c"]
    colours: Float32[np.ndarray, "v 3"]


@dataclass(frozen=True, slots=True, eq=False)
class Excess:
    """Holds, for v vertices in k views, the excess over the skin's own light, as far as the additional light is whiter
    than the skin."""

    levels: Float32[np.ndarray, "k v"]  # 0 to 255, as displayed
    sure: Bool[np.ndarray, "k v"]  # where only a highlight explains the excess
    known: Bool[np.ndarray, "k v"]  # where enough views see the vertex


@traced
def darken_highlights(
    images: Mapping[str, UInt8[np.ndarray, "_ _ 3"]], silhouettes: Mapping[str, Silhouette], rig: Rig, head_world: Mesh
) -> dict[str, UInt8[np.ndarray, "_ _ 3"]]:
    """Returns the images with the highlights on the head darkened to the skin's own light level.

    Args:
        images: sRGB photographs, by camera.
        silhouettes: silhouettes by camera; a view with an unusable silhouette is neither compared nor changed.
        rig: the cameras.
        head_world: the fitted head, mm.
    """
    out = dict(images)
    cameras = [camera for camera in rig if camera.name in images and silhouettes[camera.name].quality.usable]
    if len(cameras) < MIN_VIEWS:
        return out
    normals = head_world.normals()
    sights = map_in_threads(
        lambda k: _seen(cameras[k], images[cameras[k].name], silhouettes[cameras[k].name], head_world, normals),
        len(cameras),
    )
    excess = highlight_levels(np.stack([sight.colours for sight in sights]), head_world.faces)

    def lowered(k: int) -> UInt8[np.ndarray, "h w 3"]:
        return _lowered(images[cameras[k].name], cameras[k], sights[k], head_world, excess, k)

    out.update(zip((camera.name for camera in cameras), map_in_threads(lowered, len(cameras)), strict=True))
    return out


def highlight_levels(colours: Float32[np.ndarray, "k v 3"], faces: Int[np.ndarray, "f 3"]) -> Excess:
    """Computes, for each vertex in each view, the excess over the skin's own light that a highlight can explain.

    Args:
        colours: linear light of each view at each vertex of the head; NaN where the view does not see it.
        faces: triangles of the head, which define the neighbours of a vertex.
    """
    light = colours @ LIGHT
    seen = np.isfinite(light)
    views = seen.sum(axis=0)
    known = seen & (views >= MIN_VIEWS)
    order = np.sort(np.where(seen, light, np.inf), axis=0)
    middle = np.take_along_axis(order, np.maximum(views - 1, 0)[None] // 2, axis=0)[0]
    gain = np.ones((len(light), 1), np.float32)
    for k in range(len(light)):
        if np.count_nonzero(known[k]) >= MIN_GAIN_PLACES:
            gain[k] = np.median(light[k, known[k]] / np.maximum(middle[known[k]], 1e-4))
    light, colours = light / gain, np.where(seen[:, :, None], colours, 0.0) / gain[:, :, None]
    rank = np.argsort(np.argsort(np.where(seen, light, np.inf), axis=0), axis=0)
    dark = seen & (rank < np.ceil(DARKEST_SHARE * views))
    matt = np.where(dark[:, :, None], colours, 0.0).sum(axis=0) / np.maximum(dark.sum(axis=0), 1)[:, None]
    own_light = np.maximum(matt @ LIGHT, 1e-4)
    # What is above the skin's own light, as a share of its colour and one of white.
    tint = matt / np.maximum(np.linalg.norm(matt, axis=1, keepdims=True), 1e-6)
    apart = 1.0 - (tint @ WHITE) ** 2
    above = colours - matt
    white = (above @ WHITE - (tint @ WHITE) * np.einsum("kvc,vc->kv", above, tint)) / np.maximum(apart, COLOURED[0])
    added, floor = white * WHITE[0], MIN_SHARE * own_light
    share = np.clip((added - floor) / floor, 0.0, 1.0)
    share *= np.clip((apart - COLOURED[0]) / (COLOURED[1] - COLOURED[0]), 0.0, 1.0)
    usual = float(np.median(own_light[known.any(axis=0)])) if known.any() else 0.0
    share *= own_light > DARK_SHARE * usual
    # A head that is off by a few mm shows other skin, brows or hair in each view: what differs no more than the skin's
    # own light does nearby may be that.
    sure = known & (share > 0.5) & (added > floor + local_range(own_light, faces))
    levels = 255.0 * (np.where(known, light, own_light) ** (1.0 / GAMMA) - own_light ** (1.0 / GAMMA))
    levels = gain ** (1.0 / GAMMA) * np.maximum(levels, 0.0)
    return Excess(np.where(known, share * levels, 0.0).astype(np.float32), sure, known)


def local_range(values: Float[np.ndarray, " v"], faces: Int[np.ndarray, "f 3"]) -> Float[np.ndarray, " v"]:
    """Returns the difference between the largest and the smallest value among each vertex and its mesh neighbours
    (about 1 mm away in the face)."""
    high, low = values.copy(), values.copy()
    highest, lowest = values[faces].max(axis=1), values[faces].min(axis=1)
    for corner in faces.T:
        np.maximum.at(high, corner, highest)
        np.minimum.at(low, corner, lowest)
    return high - low


def _seen(
    camera: Camera, image: UInt8[np.ndarray, "h w 3"], silhouette: Silhouette, head_world: Mesh, normals: np.ndarray
) -> _Sight:
    vertices, k = head_world.vertices, camera.intrinsics
    pixels, depths = project_points(camera, vertices), camera_depths(camera, vertices)
    pixel_mm = float(np.median(depths)) / k.fx
    box = _box(pixels, 3.0 * SPREAD_MM / pixel_mm, k.height, k.width)
    pixels = pixels - (box[1].start, box[0].start)
    height, width = (side.stop - side.start for side in box)
    nearest, faces_seen = rasterise(pixels, depths, head_world.faces, height, width)
    cosine = facing_cosine(camera.centre_world, vertices, normals)
    with np.errstate(invalid="ignore"):  # NaN is outside
        inside = (pixels >= 0.0).all(axis=1) & (pixels <= (width - 1.0, height - 1.0)).all(axis=1)
    rows = np.flatnonzero(inside & (cosine > MIN_FACING) & (depths > 0.0))
    column, row = np.rint(pixels[rows]).astype(int).T
    clear = depths[rows] < nearest[row, column] + HIDDEN_MM + 3.0 * pixel_mm / cosine[rows]
    clear &= silhouette.distance[box][row, column] * pixel_mm < -OUTLINE_MM
    linear = cv2.LUT(image[box], np.power(np.arange(256, dtype=np.float32) / 255.0, GAMMA))
    smooth = cv2.GaussianBlur(linear, (0, 0), max(BLUR_MM / pixel_mm, 0.5))
    colours = np.full((len(vertices), 3), np.nan, np.float32)
    colours[rows[clear]] = smooth[row[clear], column[clear]]
    return _Sight(box, pixels, depths, faces_seen, colours)


def _box(pixels: Float[np.ndarray, "v 2"], margin: float, height: int, width: int) -> tuple[slice, slice]:
    """Returns the rows and columns of the image that contain the pixels and a margin, at least two of each."""
    with np.errstate(invalid="ignore"):
        seen = pixels[((pixels > -margin) & (pixels < (width + margin, height + margin))).all(axis=1)]
    low, high = (seen.min(axis=0), seen.max(axis=0)) if len(seen) else (np.zeros(2), np.zeros(2))
    column, row = np.clip(np.floor(low - margin), 0, (width - 2, height - 2)).astype(int)
    last = np.ceil(high + margin).astype(int) + 1
    return slice(row, int(np.clip(last[1], row + 2, height))), slice(column, int(np.clip(last[0], column + 2, width)))


def _lowered(
    image: UInt8[np.ndarray, "h w 3"], camera: Camera, sight: _Sight, head_world: Mesh, excess: Excess, view: int
) -> UInt8[np.ndarray, "h w 3"]:
    """Returns the image minus the view's excess light near certain highlights. The excess is smoothed in the image,
    which also extends it to pixels with unknown excess."""
    if not excess.sure[view].any():
        return image
    values = np.stack([excess.levels[view], excess.sure[view], excess.known[view]], axis=1).astype(np.float32)
    shown = interpolate(sight.faces_seen, sight.pixels, sight.depths, head_world.faces, values)
    np.nan_to_num(shown, copy=False)
    pixel_mm = float(np.median(sight.depths)) / camera.intrinsics.fx
    smooth = cv2.GaussianBlur(shown, (0, 0), SPREAD_MM / pixel_mm)
    about = _blurred_widely(np.ascontiguousarray(shown[:, :, 1:]), LOBE_MM / pixel_mm)
    levels = smooth[:, :, 0] / np.maximum(smooth[:, :, 2], MIN_COVERAGE)
    levels *= np.minimum(LOBE_FACTOR * about[:, :, 0] / np.maximum(about[:, :, 1], MIN_COVERAGE), 1.0)
    out = image.copy()
    out[sight.box] = np.clip(np.rint(image[sight.box] - levels[:, :, None]), 0.0, 255.0)
    return out


def _blurred_widely(values: Float32[np.ndarray, "h w c"], sigma: float) -> Float32[np.ndarray, "h w c"]:
    """Returns the image after a Gaussian blur of ``sigma`` pixels, computed on an image reduced to pixels of ``sigma /
    4``."""
    height, width = values.shape[:2]
    scale = max(int(sigma / 4.0), 1)
    small = cv2.resize(values, (max(width // scale, 1), max(height // scale, 1)), interpolation=cv2.INTER_AREA)
    return cv2.resize(cv2.GaussianBlur(small, (0, 0), sigma / scale), (width, height), interpolation=cv2.INTER_LINEAR)
