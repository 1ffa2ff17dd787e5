"""Computes which camera sees which point of a surface, with which weight and colour (the paper's section 4.5).

The paper requires that a point projects inside the silhouette and is not occluded. Real edges are blurred and fits are
not exact, so points near the contour or near an occluding edge are also excluded. To find occluding edges, a point is
compared with the nearest depth in a small window, corrected for the surface's slope. A view near an occluding edge, or
at a flat angle, counts only where no better view exists.

This module also packs the photographs, and the choice of photographs for each vertex, for compiled loops.
"""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass

import cv2
import numpy as np
from jaxtyping import Bool, Float, Float32, Int32, UInt8

from pipeline.geometry.projection import camera_depths, project_points
from pipeline.geometry.surface_index import facing_cosine
from pipeline.imaging.masks import box_around
from pipeline.imaging.silhouette import Silhouette
from pipeline.texturing.paint_kernels import PHASES, TAPS, Choice, Pictures
from pipeline.texturing.view_selection_kernels import POOR, sample_colours, visibility_weights
from rig.camera import Camera
from rig.colour_space import linear_from_srgb, srgb_from_linear
from rig.mesh import Mesh
from rig.rig import Rig

CODES = np.arange(256) / 255.0
Vertices = Float[np.ndarray, "v 3"]
Photograph = UInt8[np.ndarray, "h w 3"]

CONTOUR_MARGIN_PX = 2.0  # nothing is sampled nearer to the background: 3 sigma of a 0.7 px defocus
FOOTPRINT_PX = 0.45  # sigma of the sampling window; 0.7 loses 0.3 dB of detail, 0.4 lets 1.5 dB more noise
HIDDEN_MM = 1.5  # a nearer surface hides a vertex beyond this: a fit's own error, and no nose is thinner
MIN_FACING = 0.15  # cosine: at a flatter angle than 81 degrees a pixel smears over 6 mm
FACING_POWER = 1.0  # of normal . viewing direction, as the paper's weight; 2 is 1 dB worse in a view that was kept back
LINEAR = linear_from_srgb(np.arange(256) / 255.0).astype(np.float32)
CLIPS = tuple(LINEAR[[242, 254]])  # linear; noise and sharpening reach a little below the end of the scale
UNSHARP_PX = 1.0  # sigma; 1.5 is 0.6 dB worse on a head of another renderer
POWER_PX = 2.0  # sigma of the window in which detail is told from noise
NOISE_MARGIN = 2.0  # by which the median power is multiplied: its own scatter in that window is a third


@dataclass(frozen=True, slots=True, eq=False)
class Sight:
    """Holds how one camera sees each point of a surface: its weight (0 = not seen) and linear colour (0 to 1)."""

    weights: Float32[np.ndarray, " v"]
    colours: Float32[np.ndarray, "v 3"]


def see_points(
    camera: Camera,
    image: Photograph,
    silhouette: Silhouette,
    depth: Float32[np.ndarray, "h w"],
    points: Vertices,
    normals: Vertices,
) -> Sight:
    """Returns the weight and linear colour that ``camera`` gives each point of a surface (world frame, mm). ``depth``
    is the surface's depth map in that camera."""
    weights = see_weights(camera, silhouette, depth, points, normals)
    pixels = project_points(camera, points)
    colours = sample_colours(image, pixels, weights, LINEAR, FOOTPRINT_PX)
    return Sight(weights * unclipped(colours), colours)


def unclipped(colours: Float32[np.ndarray, "v 3"]) -> Float32[np.ndarray, " v"]:
    """Returns a factor for the weight of each colour: it falls from 1 well below the largest code to almost 0 at this
    code.

    A clipped value does not show how bright a point is, so a view with a longer exposure would make it too dark. Where
    all views are clipped the result is still white.
    """
    brightest = np.maximum(np.maximum(colours[:, 0], colours[:, 1]), colours[:, 2])  # a fifth of the time of ``max``
    past = (brightest - CLIPS[0]) / (CLIPS[1] - CLIPS[0])
    return np.clip(1.0 - past, POOR, 1.0).astype(np.float32)


def see_weights(
    camera: Camera, silhouette: Silhouette, depth: Float32[np.ndarray, "h w"], points: Vertices, normals: Vertices
) -> Float32[np.ndarray, " v"]:
    """Returns the weight with which ``camera`` sees each point of a surface (world frame, mm); 0 for a point that it
    does not see. ``depth`` is the surface's depth map in that camera."""
    pixels, depths = project_points(camera, points), camera_depths(camera, points)
    return visibility_weights(
        pixels,
        depths,
        facing_cosine(camera.centre_world, points, normals),
        depth,
        silhouette.distance,
        1.0 / camera.intrinsics.fx,
        (CONTOUR_MARGIN_PX, HIDDEN_MM, MIN_FACING, FACING_POWER),
    )


def sharpen(image: Photograph, inside: Bool[np.ndarray, "h w"], amount: float) -> Photograph:
    """Sharpens a photograph where it has detail. ``amount`` is the strength of the unsharp mask.

    Plain sharpening would amplify noise as well. The sharpening is therefore scaled as in a Wiener filter, by the
    fraction of the local power that exceeds the noise power. Most of a head is smooth, so the noise power is the median
    power over the head.
    """
    box = box_around(inside, 0)
    if not amount or not inside[box].size:
        return image
    crop = image[box].astype(np.float32)
    detail = crop - cv2.GaussianBlur(crop, (0, 0), UNSHARP_PX)
    power = cv2.GaussianBlur((detail * detail) @ np.full(3, 1 / 3, np.float32), (0, 0), POWER_PX)
    noise = NOISE_MARGIN * float(np.median(power[::4, ::4][inside[box][::4, ::4]]))
    gain = amount * np.clip(1 - noise / np.maximum(power, 1e-3), 0, 1)
    out = image.copy()
    out[box] = np.clip(crop + gain[:, :, None] * detail + 0.5, 0, 255)
    return out


@dataclass(frozen=True, slots=True, eq=False)
class Decision:
    """Holds the choice of photographs that colour each vertex.

    Attributes:
        views: the cameras of the photographs.
        slots: the views of each vertex, the chosen one first; -1: none.
        shares: their weights in the mean.
        corrections: sRGB codes that are added to each view at the vertex.
        weights: how well each view sees each vertex.
        pictures: the photographs, packed.
    """

    views: Rig
    slots: Int32[np.ndarray, "v s"]
    shares: Float32[np.ndarray, "v s"]
    corrections: Float32[np.ndarray, "v s 4"]
    weights: Float32[np.ndarray, "k v"]  # 0 where a view does not see a vertex
    pictures: Pictures

    def choice(self, colours: UInt8[np.ndarray, "v 3"]) -> Choice:
        """Packs the decision for the compiled loops. Triangles that no view sees get ``colours``, the sRGB codes of the
        vertices."""
        filled = np.zeros((len(colours), 4), np.float32)
        filled[:, :3] = colours
        return Choice(self.slots, self.shares, self.corrections, filled, self.weights)


def window_table(sigma: float) -> Float32[np.ndarray, "_ _"]:
    """Returns the Gaussian weights of four neighbouring pixels, one row for each sub-pixel position between the middle
    two. ``sigma`` is in pixels."""
    phase = np.arange(PHASES + 1) / PHASES
    weights = np.exp(-0.5 * ((np.arange(TAPS) - 1 - phase[:, None]) / sigma) ** 2)
    return (weights / weights.sum(axis=1, keepdims=True)).astype(np.float32)


def pack_pictures(
    views: Rig,
    images: Sequence[UInt8[np.ndarray, "_ _ 3"]],
    masks: Mapping[str, np.ndarray],
    gains: Float[np.ndarray, "k 3"],
    offsets: Float[np.ndarray, "k 3"],
    *,
    mesh_world: Mesh,
) -> Pictures:
    """Crops each photograph to its silhouette, applies the camera's gain and offset, and packs all crops into one
    array."""
    boxes = [box_around(masks[camera.name], TAPS) for camera in views]
    parts = [image[box] for image, box in zip(images, boxes, strict=True)]
    first = np.cumsum([0] + [part.size for part in parts])
    codes = np.empty(int(first[-1]), np.uint8)
    places = np.empty((len(parts), len(mesh_world.vertices), 2), np.float32)
    for k, (camera, part, box) in enumerate(zip(views, parts, boxes, strict=True)):
        target = codes[first[k] : first[k + 1]].reshape(part.shape)
        for channel in range(3):
            raised = gains[k, channel] * linear_from_srgb(CODES) + offsets[k, channel]
            table = np.rint(255 * srgb_from_linear(np.clip(raised, 0.0, 1.0))).astype(np.uint8)
            target[:, :, channel] = table[part[:, :, channel]]
        corner = (box[1].start, box[0].start)
        places[k] = np.nan_to_num(project_points(camera, mesh_world.vertices) - corner)
    width = np.array([part.shape[1] for part in parts], np.int64)
    height = np.array([part.shape[0] for part in parts], np.int64)
    return Pictures(codes, first[:-1].astype(np.int64), width, height, places, window_table(FOOTPRINT_PX))
