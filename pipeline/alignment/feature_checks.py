"""Checks feature points before a fit: their names, their number of views, whether they span a triangle, and whether
they lie on the face in the photographs. The module also suggests feature points from a detected face, for a person to
correct (the paper's section 4.2).

For suggestions, the mean head is aligned to the face and deformed to its landmarks, after the detector's mean error has
been subtracted; landmarks that slide along the surface (jaw line, forehead) are ignored. A view gets a suggested point
if its face was detected and the head does not hide the point. Suggested points are only as accurate as the face
detector. On two subjects of the simulated studio, the suggestions' errors were 1 to 3.5 mm at eyes and mouth, 5 to 6 mm
at the tip of the nose, and 1 and 12 mm (a beard) at the chin. A person therefore has to check each suggested point."""

from collections.abc import Iterable
from dataclasses import replace

import numpy as np
from jaxtyping import Bool, Float

from pipeline.alignment.feature_points import features_as_wholes, locate_features
from pipeline.alignment.landmarks import MIN_POINTS, MIN_TRIANGLE_MM, flatness
from pipeline.faces.landmark_map import LandmarkMap
from pipeline.faces.matching import MatchedFaces
from pipeline.geometry.projection import camera_depths, depth_map
from pipeline.geometry.registration.nonrigid import warp_by_landmarks
from pipeline.geometry.registration.rigid import procrustes
from pipeline.head_model.landmarks import NAMES, SEVEN_POINTS
from pipeline.head_model.model import HeadModel
from pipeline.multiview.tangency import pixel_mm
from rig.camera import Camera
from rig.capture import Features
from rig.geometry import Similarity
from rig.messages.message import Message, compose
from rig.rig import Rig

SMOOTHING_MM = 3.0  # of the bending: the finder's points err by about as much
HIDDEN_MM = 5.0  # a surface so far before a landmark hides it; the mean head's folds are not the subject's
RASTER_PX = 400  # longer side of the picture in which that is asked

Pixels = Float[np.ndarray, " 2"]
CLICK_PX = 1.5
BESIDE_MM = 20.0  # of the median point: the finder is 1 to 12 mm off where points were picked well; 70 px are 38 mm
NAMES_TOLD = 8


def feature_faults(features: Features, rig: Rig) -> list[Message]:
    """Returns the reasons why feature points determine no alignment; the list is empty if they determine one, or if
    there are none."""
    if not features:
        return []
    faults = unknown_landmarks(features)
    known = {name: views for name, views in features.items() if name in NAMES}
    single = [name for name, views in known.items() if len(views) < 2]
    faults += [compose("feature-in-one-view", name=name) for name in single]
    whole = features_as_wholes(known, rig, noise_px=CLICK_PX)
    if whole is not None:
        return [*faults, compose("of-features", fault=whole)]
    located = locate_features(known, rig, noise_px=CLICK_PX)
    points = [point.position_world for point in located.points.values()]
    if len(points) < MIN_POINTS:
        few = compose("features-too-few", count=len(points), needed=MIN_POINTS)
        remarks = located.remarks
        faults.append(compose("features-too-few-because", few=few, reasons=remarks) if remarks else few)
    elif flatness(np.stack(points)) < MIN_TRIANGLE_MM:
        faults.append(compose("features-on-line"))
    return faults


def features_beside_face(
    features: Features, face: MatchedFaces, rig: Rig, model: HeadModel, places: LandmarkMap
) -> Message | None:
    """Returns a fault if most feature points lie more than ``BESIDE_MM`` away from the face in the photographs; None
    otherwise. Points picked in cropped or resized pictures agree with each other but not with the face."""
    marks = model.levels["full"].landmarks
    names = [name for name in features if name in marks]
    if not names:
        return None
    positions, _ = locate_landmarks(face, model, places, [marks[name] for name in names])
    seen = [
        (features[name][view], rig[view], position)
        for name, position in zip(names, positions, strict=True)
        for view in features[name]
        if view in rig
    ]
    if not seen:
        return None
    picked = np.array([pixel for pixel, _, _ in seen])
    expected = np.array([camera.project(position[None])[0] for _, camera, position in seen])
    scale_mm = np.array([pixel_mm(camera, position) for _, camera, position in seen])
    ends = np.array([(camera.intrinsics.width - 1.0, camera.intrinsics.height - 1.0) for _, camera, _ in seen])

    def median_mm(pixels: Float[np.ndarray, "n 2"]) -> float:
        return float(np.median(np.linalg.norm(pixels - expected, axis=1) * scale_mm))

    distance_mm = median_mm(picked)
    if not distance_mm > BESIDE_MM:
        return None
    factor = float((picked * picked).sum() / max(float((picked * expected).sum()), 1e-9))
    right_px, down_px = np.median(picked - expected, axis=0).tolist()
    beside = compose("features-beside-face", distance_mm=distance_mm, right_px=right_px, down_px=down_px)
    readings = {
        beside: picked - (right_px, down_px),
        compose("features-from-bottom"): np.column_stack([picked[:, 0], ends[:, 1] - picked[:, 1]]),
        compose("features-of-size", factor=factor): picked / factor,
    }
    nearest = min(readings, key=lambda reading: median_mm(readings[reading]))
    return nearest if median_mm(readings[nearest]) < BESIDE_MM else beside


def unknown_landmarks(features: Features) -> list[Message]:
    """Returns a message for each landmark name that no model has, at most ``NAMES_TOLD`` of them."""
    unknown = sorted(set(features) - set(NAMES))[:NAMES_TOLD]
    return [compose("feature-unknown", name=f"{name!r:.80}", known=SEVEN_POINTS) for name in unknown]


def suggest_points(
    face: MatchedFaces, rig: Rig, model: HeadModel, places: LandmarkMap, names: Iterable[str]
) -> dict[str, dict[str, Pixels]]:
    """Suggests pixels for the landmarks ``names`` in each camera, from the detected face. Landmarks that the model
    lacks or that no view shows are left out."""
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
    """Deforms the mean head to the landmarks of a face. Returns the positions (world frame, mm) of the vertices
    ``rows`` of the deformed head, and the pose world_from_head of the mean head."""
    firm = ~places.slides
    mean = model.vertices(np.zeros(0))
    sources = places.points(mean)[firm]
    world_from_head = procrustes(sources + places.offset_mm[firm], face.points_world[firm])
    targets = world_from_head.inverse().apply(face.points_world[firm]) - places.offset_mm[firm]
    bent = warp_by_landmarks(sources, targets, mean[rows], smoothing=SMOOTHING_MM)
    return world_from_head.apply(bent), world_from_head


def _are_seen(
    camera: Camera, head_world: Float[np.ndarray, "v 3"], model: HeadModel, rows: list[int]
) -> Bool[np.ndarray, " n"]:
    """Returns a mask of the vertices ``rows`` that the camera sees, so that the mean head does not hide them."""
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
    """Returns a mask of the pixels that lie inside the camera's picture; NaN counts as outside."""
    size = (camera.intrinsics.width, camera.intrinsics.height)
    return np.asarray(((pixels > -0.5) & (pixels < np.array(size) - 0.5)).all(axis=1))
