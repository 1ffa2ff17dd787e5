"""Asks the other cameras about doubtful pixels: whether any part of the subject can lie on the pixel's ray.

A point of the ray is rejected by every camera whose mask it falls outside of. The least rejected point of the ray
counts, as for the visual hull (figure 1). One camera may be wrong where hair or a coat is lost in its backdrop, so the
answer is a number, and the caller decides.
"""

from collections.abc import Mapping

import cv2
import numpy as np
from jaxtyping import Bool, Int8

from pipeline.geometry.projection import packed_camera
from pipeline.multiview.visual_hull import mask_extent
from pipeline.segmentation.cross_view_kernels import MIN_WITNESSES, least_dissent
from rig.rig import Rig


def count_rejecting_cameras(
    doubt: Bool[np.ndarray, "h w"], name: str, masks: Mapping[str, Bool[np.ndarray, "_ _"]], rig: Rig
) -> Int8[np.ndarray, "h w"]:
    """Counts, for each doubtful pixel of camera ``name``, how many other cameras see no subject anywhere on its ray (at
    most ``MAX_DISSENT``); -1 for pixels that are not doubtful or are seen by too few cameras. Masks may be smaller than
    the images; all are reduced by the same factor."""
    out = np.full(doubt.shape, -1, np.int8)
    others = [camera for camera in rig if camera.name != name and masks[camera.name].any()]
    if len(others) < MIN_WITNESSES or not doubt.any():
        return out
    centre, edge = mask_extent({camera.name: masks[camera.name] for camera in others}, rig)
    rows, columns = np.nonzero(doubt)
    asking = rig[name]
    scale = asking.intrinsics.width / doubt.shape[1]
    rays = asking.rays_world((np.stack([columns, rows], axis=1) + 0.5) * scale - 0.5)
    distances, scales = _stacked([masks[camera.name] for camera in others], [c.intrinsics.width for c in others])
    parameters = np.array([packed_camera(camera) for camera in others])
    middle = float(np.linalg.norm(centre - asking.centre_world))
    span = (middle - 0.75 * edge, middle + 0.75 * edge)
    out[rows, columns] = least_dissent(asking.centre_world, rays, span, parameters, distances, scales)
    return out


def _stacked(masks: list[np.ndarray], widths: list[int]) -> tuple[np.ndarray, np.ndarray]:
    """Returns the distance of each pixel outside its mask (mask pixels, negative beyond the image), and how many image
    pixels wide a mask pixel is."""
    height, width = max(mask.shape[0] for mask in masks), max(mask.shape[1] for mask in masks)
    out = np.full((len(masks), height, width), -1.0, np.float32)
    for k, mask in enumerate(masks):
        away = cv2.distanceTransform((~mask).view(np.uint8), cv2.DIST_L2, cv2.DIST_MASK_5)
        out[k, : mask.shape[0], : mask.shape[1]] = away
    return out, np.array([w / mask.shape[1] for w, mask in zip(widths, masks, strict=True)])
