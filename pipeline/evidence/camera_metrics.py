"""Measures, for the report, how well a fitted head agrees with the silhouette in every camera."""

from collections.abc import Mapping
from dataclasses import dataclass

import cv2
import numpy as np
from jaxtyping import Bool, Float

from pipeline.compute.threads import map_in_threads
from pipeline.contour_fit.fit import Fit
from pipeline.contour_fit.problem import level_topology
from pipeline.contour_fit.rim import find_rim, pack_views
from pipeline.geometry.projection import depth_maps
from pipeline.head_model.model import HeadModel
from pipeline.imaging.masks import box_around
from pipeline.imaging.silhouette import Silhouette, boundary_weighted_xor, boundary_weights
from rig.camera import Camera
from rig.geometry import Similarity
from rig.mesh import Mesh
from rig.rig import Rig

EXCLUDED_PX = 3.0  # a rim sample farther from the input than this is clutter or misfit, and hardly counts in the fit
START_LEVEL = "p95"  # of the head before the fit, which is centimetres off: drawn in a third of the time
ZONE_MARGIN_PX = 4  # how far the face's zone reaches beyond its own hull, so that a face that is too large shows

Masks = Mapping[str, Bool[np.ndarray, "h w"]]


@dataclass(frozen=True, slots=True)
class CameraFigures:
    """Holds measures of how well the fitted head agrees with one camera's silhouette.

    ``iou`` and ``contour_rms_px`` are over all rim samples of the face region, outliers included; ``excluded_share`` is
    the fraction of them (0 to 1) whose residual is too large for the fit. ``xor_cost`` is eq. (5) for the fitted head,
    ``xor_cost_start`` for the head at the start of the fit. ``outside_rms_px`` is over rim samples outside the mask
    only, because hair, hands or shoulders may hide samples inside. A value is None if the view has no rim sample.
    """

    used: bool
    iou: float | None
    contour_rms_px: float | None
    xor_cost: float | None
    xor_cost_start: float | None = None
    excluded_share: float | None = None
    samples: int = 0
    outside_rms_px: float | None = None


def measure_cameras(
    model: HeadModel, fit: Fit, silhouettes: Mapping[str, Silhouette], rig: Rig, fitted: Masks, started: Masks
) -> dict[str, CameraFigures]:
    """Computes the figures of every camera, in the order of the rig. The function uses the calibrated cameras without
    the corrections of the fit."""
    level = model.levels["full"]
    vertices = fit.world_from_head.apply(model.vertices(fit.coefficients))
    views = pack_views(rig, {camera.name: silhouettes[camera.name].distance for camera in rig})
    rim = find_rim(level_topology(model, "full"), vertices, views)
    face = vertices[level.face_region]

    def figures_of(k: int, camera: Camera) -> CameraFigures:
        here = rim.view == k
        length, residual = rim.length[here], rim.residual[here]
        observed, spoke = silhouettes[camera.name].mask, float(length.sum()) > 0
        before, after = _costs(observed, started[camera.name], fitted[camera.name])
        return CameraFigures(
            used=fit.used.get(camera.name, False),
            iou=_overlap(observed, fitted[camera.name], _zone(camera, face)),
            contour_rms_px=_rms(residual, length) if spoke else None,
            excluded_share=float(length[np.abs(residual) > EXCLUDED_PX].sum() / length.sum()) if spoke else None,
            xor_cost=after,
            xor_cost_start=before,
            samples=int(here.sum()),
            outside_rms_px=_rms(np.maximum(residual, 0.0), length) if spoke else None,
        )

    found = map_in_threads(lambda k: figures_of(k, rig.cameras[k]), len(rig))
    return dict(zip(rig.names, found, strict=True))


def _rms(values: Float[np.ndarray, " n"], weight: Float[np.ndarray, " n"]) -> float:
    return float(np.sqrt((weight @ values**2) / weight.sum()))


def _costs(observed: Bool[np.ndarray, "h w"], *models: Bool[np.ndarray, "h w"]) -> list[float]:
    """Returns the XOR cost of the paper's eq. (5) for each mask, computed in the bounding box of all masks."""
    everything = observed.copy()
    for model in models:
        everything |= model
    box = box_around(everything, 1)
    weights = boundary_weights(observed[box])
    return [boundary_weighted_xor(observed[box], model[box], weights) for model in models]


def _zone(camera: Camera, face_world: Float[np.ndarray, "v 3"]) -> Bool[np.ndarray, "h w"]:
    """Returns a mask of the face's convex hull in the image, with a margin."""
    zone = np.zeros((camera.intrinsics.height, camera.intrinsics.width), np.uint8)
    pixels = camera.project(face_world)
    pixels = pixels[np.isfinite(pixels).all(axis=1)]
    if len(pixels) > 2:
        cv2.fillConvexPoly(zone, cv2.convexHull(np.round(pixels).astype(np.int32)), 1)
    size = 2 * ZONE_MARGIN_PX + 1
    return cv2.dilate(zone, np.ones((size, size), np.uint8)) > 0


def _overlap(
    observed: Bool[np.ndarray, "h w"], fitted: Bool[np.ndarray, "h w"], zone: Bool[np.ndarray, "h w"]
) -> float | None:
    """Returns the intersection over union of two masks inside ``zone``; None if both masks are empty there."""
    union = np.count_nonzero((observed | fitted) & zone)
    return float(np.count_nonzero(observed & fitted & zone) / union) if union else None


def start_masks(model: HeadModel, world_from_head: Similarity, rig: Rig) -> dict[str, Bool[np.ndarray, "h w"]]:
    """Returns the mask of the aligned mean head in each camera."""
    vertices = world_from_head.apply(model.vertices(np.zeros(0), START_LEVEL))
    depths = depth_maps(rig, Mesh(vertices, model.levels[START_LEVEL].faces))
    return {name: np.isfinite(depth) for name, depth in depths.items()}
