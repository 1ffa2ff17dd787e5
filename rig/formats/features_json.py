"""Feature points in a file: ``features.json`` (``eigenhead-features/1``)."""

import json
from typing import Any, TypedDict

import numpy as np

from rig.capture import Features
from rig.rig import Rig

FEATURES_FORMAT = "eigenhead-features/1"
POINTS_MOST = 200  # feature points in features.json


class FeaturesDocument(TypedDict):
    """Pixels by point and camera."""

    format: str
    points: dict[str, dict[str, list[float]]]


def features_from_bytes(data: bytes, rig: Rig, faults: list[str]) -> Features:
    """The points of a ``features.json``; appends every fault to ``faults``."""
    try:
        document = json.loads(data)
    except (ValueError, RecursionError) as error:
        faults.append(f"features.json cannot be read as JSON ({error})")
        return {}
    return features_from_document(document, rig, faults)


def features_from_document(document: Any, rig: Rig, faults: list[str]) -> Features:
    """The points of a decoded ``features.json``; appends every fault to ``faults``."""
    if not isinstance(document, dict) or not isinstance(document.get("points"), dict):
        faults.append("features.json is no object with an object 'points'")
        return {}
    if document.get("format") != FEATURES_FORMAT:
        faults.append(f"features.json: format is {document.get('format')!r:.80}, wanted {FEATURES_FORMAT!r}")
    if len(document["points"]) > POINTS_MOST:
        faults.append(f"features.json: {len(document['points'])} points, at most {POINTS_MOST} are read")
        return {}
    features: dict[str, dict[str, np.ndarray]] = {}
    for landmark, views in document["points"].items():
        if not isinstance(views, dict):
            faults.append(f"features.json: {landmark!r:.80} is no object of camera: [u, v]")
            continue
        for name, pixel in views.items():
            point = _pixel(pixel)
            if name not in rig:
                faults.append(f"features.json: {landmark!r:.80} names camera {name!r:.80}, which the rig does not have")
            elif point is None:
                faults.append(f"features.json: {landmark!r:.80} in {name}: {pixel!r:.80} is no pair of finite pixels")
            elif not _inside(point, rig[name].intrinsics.width, rig[name].intrinsics.height):
                faults.append(f"features.json: {landmark!r:.80} in {name}: {pixel!r:.80} lies outside the image")
            else:
                features.setdefault(landmark, {})[name] = point
    return features


def document_from_features(features: Features) -> FeaturesDocument:
    points = {k: {name: [float(x) for x in pixel] for name, pixel in views.items()} for k, views in features.items()}
    return {"format": FEATURES_FORMAT, "points": points}


def _pixel(value: Any) -> np.ndarray | None:
    if not isinstance(value, list) or len(value) != 2:
        return None
    # NaN fails the comparison, and so does a whole number too large for a float
    if not all(isinstance(x, int | float) and not isinstance(x, bool) and abs(x) < 1e9 for x in value):
        return None
    return np.array(value, dtype=float)


def _inside(point: np.ndarray, width: int, height: int) -> bool:
    return bool((point >= -0.5).all() and point[0] <= width - 0.5 and point[1] <= height - 0.5)
