"""Computes the paper's objective (eqs. 2 and 5): the boundary-weighted XOR of input and model silhouettes, over all
cameras.

The objective's input is shape coefficients. The output is one number; the renderer draws and sums the pixels, so no
image is read back.

Some pixels get no weight. In eq. (5) a mismatch far from the input contour has hardly any weight. Such a low weight
suffices for parts *inside* the outline that the model lacks, but not for parts of the input outside it that no model
can reproduce. Below the model's cut through the neck, the input silhouette continues into shoulders; every pixel by
which the mesh's open edge moves down would reduce the cost, and the head would grow a neck. Hair would reward an
enlarged skull in the same way. A pixel therefore counts only if the nearest part of the aligned head's outline belongs
to the face region (ear to ear, forehead to chin); all other pixels have weight zero. The pixels are chosen once for
each mesh, from the head at the start of its search, so that the cost during the search is a fixed function of the
coefficients: eq. (5) with some weights zero. ``speaking="all"`` gives exactly the paper's cost.

Pixels at the neck's cut have no weight, so triangles close the mesh there and back faces need not be drawn, which saves
5 of 19 ms in each evaluation. If the cut is not flat, these triangles add a thousandth of the silhouette's area."""

from collections.abc import Mapping
from itertools import pairwise
from types import TracebackType
from typing import Literal

import cv2
import numpy as np
from jaxtyping import Bool, Float, Int

from pipeline.head_model.model import HeadModel
from pipeline.imaging.silhouette import Silhouette, boundary_weights, signed_distance
from rig.geometry import Similarity
from rig.render.renderer import Renderer
from rig.rig import Rig

TIE_PX = 0.1  # a binary mask places its contour no better than this
OUTLINE_PX = 2.0  # a vertex this near to the model's outline names the region of that stretch of it


class SilhouetteObjective:
    """Computes the paper's eq. (2) at one step of the hierarchy, with the renderer's buffers for this step. The caller
    must call ``close`` after use, or use ``with``."""

    def __init__(
        self,
        model: HeadModel,
        world_from_head: Similarity,
        silhouettes: Mapping[str, Silhouette],
        rig: Rig,
        *,
        renderer: Renderer,
        level: str,
        scale: float,
        start: Float[np.ndarray, " m"],
        speaking: Literal["face", "all"] = "face",
        weighted: bool = True,
    ) -> None:
        """Takes a mesh ``level`` of the model and a ``scale`` of the images (0.5 is half the width); the head at
        ``start`` decides which pixels count. ``weighted`` selects the paper's eq. (5), otherwise eq. (4)."""
        self._turn = world_from_head.scale * world_from_head.rotation
        mean = model.levels[level].operator @ model.mean
        self._mean_world = world_from_head.apply(mean.astype(np.float64))
        self._basis = model.basis(level, len(start)).reshape(len(start), -1)
        faces, region = model.levels[level].faces, model.levels[level].face_region
        self._drawn = renderer.silhouette_set(rig, close_holes(faces, region) if speaking == "face" else faces, scale)
        scaled = self._drawn.rig
        masks = {camera.name: mask_at_scale(silhouettes[camera.name].distance, scale) for camera in rig}
        weights = {
            name: boundary_weights(mask) if weighted else np.ones_like(mask, np.float32) for name, mask in masks.items()
        }
        if speaking == "face":
            outlines = self._drawn.masks(self.vertices_world(start))
            region = model.levels["full"].face_region
            vertices = world_from_head.apply(model.vertices(start, "full"))
            for camera in scaled:
                speaks = face_pixels(outlines[camera.name], camera.project(vertices), region)
                weights[camera.name] = weights[camera.name] * speaks
        self._drawn.set_inputs(masks, weights)

    def __enter__(self) -> "SilhouetteObjective":
        return self

    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None
    ) -> None:
        self._drawn.close()

    def __call__(self, coefficients: Float[np.ndarray, " m"]) -> float:
        """Returns the cost E of the paper's eq. (2) at ``coefficients`` (standard deviations), in contour pixels."""
        return float(self._drawn.xor_costs(self.vertices_world(coefficients)).sum())

    def vertices_world(self, coefficients: Float[np.ndarray, " m"]) -> Float[np.ndarray, "v 3"]:
        """Returns the mesh's vertices for these coefficients (world frame, mm), which is T(H(alpha)) in the paper."""
        moved = (np.asarray(coefficients, np.float32) @ self._basis).reshape(-1, 3)
        return self._mean_world + moved @ self._turn.T


def close_holes(faces: Int[np.ndarray, "f 3"], face_region: Bool[np.ndarray, " v"]) -> Int[np.ndarray, "g 3"]:
    """Closes every hole of a mesh with a fan of triangles, so that each edge belongs to two triangles. Returns the
    triangles unchanged if a hole reaches the face region, whose outline has weight, or if two holes touch."""
    directed = np.concatenate([faces[:, [0, 1]], faces[:, [1, 2]], faces[:, [2, 0]]]).tolist()
    edges = {(a, b) for a, b in directed}
    rim = [(a, b) for a, b in edges if (b, a) not in edges]
    after = {b: a for a, b in rim}  # around a hole, against its edges
    if len(after) < len(rim) or face_region[list(after)].any():
        return faces
    lids = []
    while after:
        first, at = after.popitem()
        ring = [first]
        while at != first:
            ring.append(at)
            at = after.pop(at)
        lids += [(first, b, c) for b, c in pairwise(ring[1:])]
    return np.concatenate([faces, np.array(lids, faces.dtype).reshape(-1, 3)])


def mask_at_scale(distance: Float[np.ndarray, "h w"], scale: float) -> Bool[np.ndarray, "_ _"]:
    """Returns the mask at another resolution: True where a pixel's centre lies inside the contour, as in the renderer.

    The mask is computed from the signed distance (px, negative inside), averaged over each larger pixel. The contour of
    a binary mask often passes exactly through a larger pixel's centre. If all pixels with such a centre had the same
    value, the contour would move by 0.15 px everywhere (0.3 px if the mask's pixels were counted), so their values
    alternate like a chessboard."""
    height, width = distance.shape
    smaller = cv2.resize(distance, (round(width * scale), round(height * scale)), interpolation=cv2.INTER_AREA)
    rows, columns = np.ogrid[: smaller.shape[0], : smaller.shape[1]]
    return smaller < np.where((rows + columns) % 2, TIE_PX, -TIE_PX)


def face_pixels(
    outline_mask: Bool[np.ndarray, "h w"], pixels: Float[np.ndarray, "v 2"], face_region: Bool[np.ndarray, " v"]
) -> Bool[np.ndarray, "h w"]:
    """Returns a mask of the pixels whose nearest part of the model's outline belongs to the face region. ``pixels`` are
    the model's vertices in this view; vertices near the edge of ``outline_mask`` decide which part of the outline
    belongs to the face."""
    height, width = outline_mask.shape
    with np.errstate(invalid="ignore"):
        nearest = np.round(pixels)
        inside = (nearest >= 0).all(axis=1) & (nearest < (width, height)).all(axis=1)
    columns, rows = nearest[inside].astype(int).T
    near = np.abs(signed_distance(outline_mask)[rows, columns]) < OUTLINE_PX
    columns, rows, face = columns[near], rows[near], face_region[inside][near]
    votes = np.zeros((height, width), np.int32)
    np.add.at(votes, (rows, columns), np.where(face, 1, -1))
    named = np.ones((height, width), np.uint8)
    named[rows, columns] = 0  # distanceTransformWithLabels looks for the nearest zero
    if named.all():
        return np.zeros((height, width), bool)
    _, found = cv2.distanceTransformWithLabels(named, cv2.DIST_L2, 5, labelType=cv2.DIST_LABEL_PIXEL)
    labels = np.asarray(found, np.int32)
    face_of_label = np.zeros(int(labels.max()) + 1, bool)
    face_of_label[labels[rows, columns]] = votes[rows, columns] > 0
    return face_of_label[labels]
