"""Suggests feature points from a found face, as a start for a person who picks them (section 4.2).

Enters: a face matched over the views, a head model, and which points of the model the face's landmarks are. Leaves:
pixels by landmark and camera. The mean head is laid on the face and deformed to its landmarks, with the face detector's
mean error subtracted; jaw line and forehead, along which landmarks slide, are left out. A view gets a landmark if the
face was found in it and the head does not hide the landmark.

The result is as good as the detector. On two subjects of the simulated studio it was 1 to 3.5 mm off at eyes and mouth,
5 to 6 at the tip of the nose, 1 and 12 (a beard) at the chin. Each point has to be checked.
"""

from collections.abc import Iterable
from dataclasses import replace

import numpy as np
from jaxtyping import Bool, Float

from pipeline.faces.landmark_map import LandmarkMap
from pipeline.faces.matching import MatchedFaces
from pipeline.geometry.raster import camera_depths, depth_map
from pipeline.geometry.registration.procrustes import procrustes
from pipeline.geometry.warp import landmark_warp
from pipeline.head_model.model import HeadModel
from rig.camera import Camera
from rig.geometry import Similarity
from rig.rig import Rig

SMOOTHING_MM = 3.0  # of the bending: the finder's points err by about as much
HIDDEN_MM = 5.0  # a surface so far before a landmark hides it; the mean head's folds are not the subject's
RASTER_PX = 400  # longer side of the picture in which that is asked

Pixels = Float[np.ndarray, " 2"]


def suggest_points(
    face: MatchedFaces, rig: Rig, model: HeadModel, places: LandmarkMap, names: Iterable[str]
) -> dict[str, dict[str, Pixels]]:
    """Suggests pixels for the landmarks ``names`` in each camera, from a face in the photographs. Landmarks that the
    model lacks or that no view shows are left out."""
    marks = model.levels["full"].landmarks
    rows = {name: marks[name] for name in names if name in marks}
    positions, world_from_head = locate_landmarks(face, model, places, list(rows.values()))
    head_world = world_from_head.apply(model.vertices(np.zeros(0)))
    suggested: dict[str, dict[str, Pixels]] = {name: {} for name in rows}
    for camera in (rig[name] for name in face.detections):
        pixels = camera.project(positions)
        seen = _are_seen(camera, head_world, model, list(rows.values()))
        for name, pixel, is_seen in zip(rows, pixels, seen & _are_inside(camera, pixels), strict=True):
            if is_seen:
                suggested[name][camera.name] = pixel
    return {name: views for name, views in suggested.items() if views}


def locate_landmarks(
    face: MatchedFaces, model: HeadModel, places: LandmarkMap, rows: list[int]
) -> tuple[Float[np.ndarray, "n 3"], Similarity]:
    """Deforms the mean head to a face. Returns the positions (world, mm) of its vertices ``rows``, and the pose
    world_from_head of the mean head."""
    firm = ~places.slides
    mean = model.vertices(np.zeros(0))
    sources = places.points(mean)[firm]
    world_from_head = procrustes(sources + places.offset_mm[firm], face.points_world[firm])
    targets = world_from_head.inverse().apply(face.points_world[firm]) - places.offset_mm[firm]
    bent = landmark_warp(sources, targets, mean[rows], smoothing=SMOOTHING_MM)
    return world_from_head.apply(bent), world_from_head


def _are_seen(
    camera: Camera, head_world: Float[np.ndarray, "v 3"], model: HeadModel, rows: list[int]
) -> Bool[np.ndarray, " n"]:
    """Tells which of the vertices ``rows`` the camera sees, not hidden by the mean head itself."""
    longest = max(camera.intrinsics.width, camera.intrinsics.height)
    small = replace(camera, intrinsics=camera.intrinsics.scaled(min(1.0, RASTER_PX / longest)))
    surface, _ = depth_map(small, head_world, model.levels["full"].faces)
    pixels, depths = small.project(head_world[rows]), camera_depths(small, head_world[rows])
    seen = np.zeros(len(rows), bool)
    inside = _are_inside(small, pixels)
    columns, lines = np.rint(pixels[inside]).astype(int).T
    seen[inside] = surface[lines, columns] > depths[inside] - HIDDEN_MM
    return seen


def _are_inside(camera: Camera, pixels: Float[np.ndarray, "n 2"]) -> Bool[np.ndarray, " n"]:
    """Tells which pixels lie inside the camera's picture; NaN lies outside."""
    size = (camera.intrinsics.width, camera.intrinsics.height)
    return np.asarray(((pixels > -0.5) & (pixels < np.array(size) - 0.5)).all(axis=1))
