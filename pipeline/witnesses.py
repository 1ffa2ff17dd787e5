"""What other cameras say of doubtful pixels: could anything of the subject stand on the pixel's ray?

A point of the ray is denied by every camera whose mask it falls outside of; of all points on the ray the least denied
one counts, as for the visual hull (figure 1). One camera may err where another's hair or coat is lost in its backdrop,
so that the answer is a number, and the asking side decides.
"""

from collections.abc import Mapping

import cv2
import numpy as np
from jaxtyping import Bool, Int8
from numba import njit

from pipeline.lens import distorted
from pipeline.visual_hull import camera_parameters, mask_extent
from rig.layout import Rig

MOST = 3  # more dissent than this is not counted
LEAST_WITNESSES = 4  # cameras that must see a point before it can be allowed
STEPS = 96  # points on a ray: 4 mm on a subject of 400 mm
SLACK = 1.0  # mask pixels by which a point may miss a mask


def ask_the_others(
    doubt: Bool[np.ndarray, "h w"], name: str, masks: Mapping[str, Bool[np.ndarray, "_ _"]], rig: Rig
) -> Int8[np.ndarray, "h w"]:
    """How many of the other cameras deny the subject at each doubtful pixel of camera ``name`` (at most ``MOST``); -1
    where nobody was asked or too few can see.

    Masks may be smaller than the images; all are evenly reduced.
    """
    out = np.full(doubt.shape, -1, np.int8)
    others = [camera for camera in rig if camera.name != name and masks[camera.name].any()]
    if len(others) < LEAST_WITNESSES or not doubt.any():
        return out
    centre, edge = mask_extent({camera.name: masks[camera.name] for camera in others}, rig)
    rows, columns = np.nonzero(doubt)
    asking = rig[name]
    scale = asking.intrinsics.width / doubt.shape[1]
    rays = asking.rays_world((np.stack([columns, rows], axis=1) + 0.5) * scale - 0.5)
    distances, scales = _stacked([masks[camera.name] for camera in others], [c.intrinsics.width for c in others])
    parameters = np.array([camera_parameters(camera) for camera in others])
    middle = float(np.linalg.norm(centre - asking.centre_world))
    span = (middle - 0.75 * edge, middle + 0.75 * edge)
    out[rows, columns] = _least_dissent(asking.centre_world, rays, span, parameters, distances, scales)
    return out


def _stacked(masks: list[np.ndarray], widths: list[int]) -> tuple[np.ndarray, np.ndarray]:
    """Distances (mask pixels) outside each mask, negative beyond the images; and image pixels a mask pixel."""
    height, width = max(mask.shape[0] for mask in masks), max(mask.shape[1] for mask in masks)
    out = np.full((len(masks), height, width), -1.0, np.float32)
    for k, mask in enumerate(masks):
        away = cv2.distanceTransform((~mask).view(np.uint8), cv2.DIST_L2, cv2.DIST_MASK_5)
        out[k, : mask.shape[0], : mask.shape[1]] = away
    return out, np.array([w / mask.shape[1] for w, mask in zip(widths, masks, strict=True)])


@njit(cache=True, nogil=True)
def _least_dissent(
    origin: np.ndarray,
    rays: np.ndarray,
    span: tuple[float, float],
    cameras: np.ndarray,
    distances: np.ndarray,
    scales: np.ndarray,
) -> np.ndarray:
    out = np.full(len(rays), -1, np.int8)
    step = (span[1] - span[0]) / STEPS
    for n in range(len(rays)):
        best = MOST + 1
        for s in range(STEPS):
            reach = span[0] + (s + 0.5) * step
            x, y, z = (origin[0] + reach * rays[n, 0], origin[1] + reach * rays[n, 1], origin[2] + reach * rays[n, 2])
            seen, against = 0, 0
            for k in range(len(cameras)):
                p = cameras[k]
                cz = p[6] * x + p[7] * y + p[8] * z + p[11]
                if cz <= 1.0:
                    continue
                u = (p[0] * x + p[1] * y + p[2] * z + p[9]) / cz
                v = (p[3] * x + p[4] * y + p[5] * z + p[10]) / cz
                column, row = distorted(u, v, p[12:])
                i, j = int((row + 0.5) / scales[k]), int((column + 0.5) / scales[k])
                if row < 0 or column < 0 or i >= distances.shape[1] or j >= distances.shape[2]:
                    continue
                away = distances[k, i, j]
                if away < 0:
                    continue
                seen += 1
                against += away > SLACK + 0.5 * step * p[12] / (cz * scales[k])
                if against >= best:
                    break
            if seen >= LEAST_WITNESSES and against < best:
                best = against
                if best == 0:
                    break
        if best <= MOST:
            out[n] = best
        elif best == MOST + 1:
            out[n] = MOST
    return out
