"""Holds which photograph colours each vertex, and the photographs packed for compiled loops: what vertex colours and
texels share."""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass

import numpy as np
from jaxtyping import Float, Float32, Int32, UInt8

from pipeline.geometry.projection import project_points
from pipeline.imaging.masks import box_around
from pipeline.texturing.paint_kernels import PHASES, TAPS, Choice, Pictures
from pipeline.texturing.visibility import FOOTPRINT_PX
from rig.colour_space import linear_from_srgb, srgb_from_linear
from rig.mesh import Mesh
from rig.rig import Rig

CODES = np.arange(256) / 255.0


@dataclass(frozen=True, slots=True, eq=False)
class Decision:
    """Holds which photographs colour each vertex.

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
        """Returns the decision as the compiled loops take it. ``colours`` (sRGB codes of the vertices) are used in
        triangles that no view sees."""
        filled = np.zeros((len(colours), 4), np.float32)
        filled[:, :3] = colours
        return Choice(self.slots, self.shares, self.corrections, filled, self.weights)


def window_table(sigma: float) -> Float32[np.ndarray, "_ _"]:
    """Returns the Gaussian weights with which four neighbouring pixels are read, one row for each sub-pixel position
    between the middle two. ``sigma`` is in pixels."""
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
    """Packs the part of each photograph around its silhouette into one array, with the camera's gain and offset
    applied."""
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
