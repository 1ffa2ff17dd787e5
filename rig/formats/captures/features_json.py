"""Reads and writes ``features.json`` (``eigenhead-features/1``), which holds the pixels of landmarks by camera."""

import json
from typing import Any, TypedDict

import numpy as np

from rig.camera import Camera
from rig.capture import Features
from rig.messages.message import Message, compose, say_once
from rig.rig import Rig

FILE = "features.json"
FEATURES_FORMAT = "eigenhead-features/1"
POINTS_MOST = 200  # feature points in features.json
OUTSIDE_LEAST, OUTSIDE_SHARE = 3, 0.2  # points outside their pictures, and of all, that are no slip of the hand


class FeaturesDocument(TypedDict):
    """Describes ``features.json``, which holds pixels by landmark and camera."""

    format: str
    points: dict[str, dict[str, list[float]]]


def features_from_bytes(data: bytes, rig: Rig, faults: list[Message]) -> Features:
    """Reads the points in the bytes of a ``features.json``. Appends every fault to ``faults``."""
    try:
        document = json.loads(data)
    except (ValueError, RecursionError) as error:
        faults.append(compose("of-file", file=FILE, fault=compose("no-json", reason=str(error))))
        return {}
    return features_from_document(document, rig, faults)


def features_from_document(document: Any, rig: Rig, faults: list[Message]) -> Features:
    """Returns the points of a decoded ``features.json``. Appends every fault to ``faults``."""
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
    whole = _fault_of_all(document["points"], rig)
    if whole is not None:
        faults.append(compose("located", where=FILE, fault=whole))
        return {}
    features: dict[str, dict[str, np.ndarray]] = {}
    strange: list[Message] = []
    for landmark, views in document["points"].items():
        if not isinstance(views, dict):
            strange.append(_of_point(landmark, compose("feature-no-object")))
            continue
        for name, pixel in views.items():
            point = _pixel(pixel)
            if name not in rig:
                strange.append(_of_point(landmark, compose("feature-strange-camera", camera=f"{name!r:.80}")))
            elif point is None:
                strange.append(_of_point(landmark, compose("feature-no-pixels", camera=name, pixel=f"{pixel!r:.80}")))
            elif not _is_in_picture(point, rig[name]):
                strange.append(_of_point(landmark, compose("feature-outside", camera=name, pixel=f"{pixel!r:.80}")))
            else:
                features.setdefault(landmark, {})[name] = point
    inner = {name for views in document["points"].values() if isinstance(views, dict) for name in views}
    faults += say_once(strange, {*rig.names, *document["points"], *inner})
    return features


def _fault_of_all(points: dict[str, Any], rig: Rig) -> Message | None:
    """Returns a fault that all points share: cameras and landmarks nested in the wrong order, fractions of the picture
    instead of pixels, or pixels of pictures of another size. Returns None if the points have no common fault."""
    inner = {name for views in points.values() if isinstance(views, dict) for name in views}
    if points and inner and all(name in rig for name in points) and not any(name in rig for name in inner):
        return compose("features-by-camera")
    pairs = [
        (rig[name], point)
        for views in points.values()
        if isinstance(views, dict)
        for name, pixel in views.items()
        if name in rig and (point := _pixel(pixel)) is not None
    ]
    if len(pairs) >= OUTSIDE_LEAST and all(point.min() >= 0.0 and point.max() <= 1.0 for _, point in pairs):
        return compose("features-in-shares")
    outside = [(camera, point) for camera, point in pairs if not _is_in_picture(point, camera)]
    if len(outside) < max(OUTSIDE_LEAST, OUTSIDE_SHARE * len(pairs)):
        return None
    if all(_is_in_picture(point[::-1], camera) for camera, point in pairs):
        return compose("features-transposed")
    camera, point = outside[0]
    size = f"{camera.intrinsics.width} x {camera.intrinsics.height}"
    pixel = f"[{point[0]:.0f}, {point[1]:.0f}]"
    return compose("features-outside", count=len(outside), all=len(pairs), pixel=pixel, camera=camera.name, size=size)


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


def _is_in_picture(point: np.ndarray, camera: Camera) -> bool:
    k = camera.intrinsics
    return bool((point >= -0.5).all() and point[0] <= k.width - 0.5 and point[1] <= k.height - 0.5)
