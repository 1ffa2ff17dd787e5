"""Reads and writes ``features.json`` (``eigenhead-features/1``): feature points, pixels of landmarks by camera."""

import json
from typing import Any, TypedDict

import numpy as np

from rig.capture import Features
from rig.messages.message import Message, compose
from rig.rig import Rig

FILE = "features.json"
FEATURES_FORMAT = "eigenhead-features/1"
POINTS_MOST = 200  # feature points in features.json


class FeaturesDocument(TypedDict):
    """Describes ``features.json``: pixels by point and camera."""

    format: str
    points: dict[str, dict[str, list[float]]]


def features_from_bytes(data: bytes, rig: Rig, faults: list[Message]) -> Features:
    """Returns the points of a ``features.json``; appends every fault to ``faults``."""
    try:
        document = json.loads(data)
    except (ValueError, RecursionError) as error:
        faults.append(compose("of-file", file=FILE, fault=compose("no-json", reason=str(error))))
        return {}
    return features_from_document(document, rig, faults)


def features_from_document(document: Any, rig: Rig, faults: list[Message]) -> Features:
    """Returns the points of a decoded ``features.json``; appends every fault to ``faults``."""
    if not isinstance(document, dict) or not isinstance(document.get("points"), dict):
        faults.append(compose("of-file", file=FILE, fault=compose("features-no-points")))
        return {}
    if document.get("format") != FEATURES_FORMAT:
        observed = f"{document.get('format')!r:.80}"
        faults.append(
            compose("located", where=FILE, fault=compose("format-is", format=observed, wanted=f"{FEATURES_FORMAT!r}"))
        )
    if len(document["points"]) > POINTS_MOST:
        fault = compose("features-many", count=len(document["points"]), most=POINTS_MOST)
        faults.append(compose("located", where=FILE, fault=fault))
        return {}
    features: dict[str, dict[str, np.ndarray]] = {}
    for landmark, views in document["points"].items():
        if not isinstance(views, dict):
            faults.append(_of_point(landmark, compose("feature-no-object")))
            continue
        for name, pixel in views.items():
            point = _pixel(pixel)
            if name not in rig:
                faults.append(_of_point(landmark, compose("feature-strange-camera", camera=f"{name!r:.80}")))
            elif point is None:
                faults.append(_of_point(landmark, compose("feature-no-pixels", camera=name, pixel=f"{pixel!r:.80}")))
            elif not _inside(point, rig[name].intrinsics.width, rig[name].intrinsics.height):
                faults.append(_of_point(landmark, compose("feature-outside", camera=name, pixel=f"{pixel!r:.80}")))
            else:
                features.setdefault(landmark, {})[name] = point
    return features


def _of_point(landmark: str, fault: Message) -> Message:
    return compose("located", where=FILE, fault=compose("of-file", file=f"{landmark!r:.80}", fault=fault))


def document_from_features(features: Features) -> FeaturesDocument:
    """Returns the content of ``features.json``."""
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
