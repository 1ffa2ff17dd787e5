"""Checks feature points before a fit: their names, in how many views they are, whether they span a triangle, and
whether they lie on the face in the photographs."""

import numpy as np
from jaxtyping import Float

from pipeline.alignment.feature_points import features_as_wholes, locate_features
from pipeline.alignment.landmarks import MIN_POINTS, MIN_TRIANGLE_MM, flatness
from pipeline.alignment.suggested_points import locate_landmarks
from pipeline.faces.landmark_map import LandmarkMap
from pipeline.faces.matching import MatchedFaces
from pipeline.head_model.landmarks import NAMES, SEVEN_POINTS
from pipeline.head_model.model import HeadModel
from pipeline.multiview.tangency import pixel_mm
from rig.capture import Features
from rig.messages.message import Message, compose
from rig.rig import Rig

CLICK_PX = 1.5
BESIDE_MM = 20.0  # of the median point: the finder is 1 to 12 mm off where points were picked well; 70 px are 38 mm
NAMES_TOLD = 8


def feature_faults(features: Features, rig: Rig) -> list[Message]:
    """Returns the reasons why feature points determine no alignment; an empty list if they do, or if there are none."""
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
    """Returns the fault of feature points most of which lie more than ``BESIDE_MM`` beside the face in the photographs;
    None if they do not. Points that were picked in cropped pictures, or in pictures of another size, agree with each
    other but not with the face."""
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
