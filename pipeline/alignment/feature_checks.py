"""What can be said against feature points before a fit: names, views, and whether they span a triangle."""

import numpy as np

from pipeline.alignment.feature_points import features_as_wholes, locate_features
from pipeline.alignment.landmarks import MIN_POINTS, MIN_TRIANGLE_MM, flatness
from pipeline.head_model.landmarks import NAMES, SEVEN_POINTS
from rig.capture import Features
from rig.messages.message import Message, compose
from rig.rig import Rig

CLICK_PX = 1.5
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


def unknown_landmarks(features: Features) -> list[Message]:
    """Returns a message for each landmark name that no model has, at most ``NAMES_TOLD`` of them."""
    unknown = sorted(set(features) - set(NAMES))[:NAMES_TOLD]
    return [compose("feature-unknown", name=f"{name!r:.80}", known=SEVEN_POINTS) for name in unknown]
