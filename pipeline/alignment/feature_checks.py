"""What can be said against feature points before a fit: names, views, and whether they span a triangle."""

import numpy as np

from pipeline.alignment.feature_points import locate_features
from pipeline.alignment.landmarks import POINTS_LEAST, TRIANGLE_LEAST_MM, flatness
from pipeline.eigenheads.landmarks import NAMES, SEVEN_POINTS
from rig.capture import Features
from rig.rig import Rig

CLICK_PX = 1.5
NAMES_TOLD = 8


def feature_faults(features: Features, rig: Rig) -> list[str]:
    """Why these points determine no alignment; nothing where they do, or where there are none."""
    if not features:
        return []
    faults = unknown_landmarks(features)
    known = {name: views for name, views in features.items() if name in NAMES}
    single = [name for name, views in known.items() if len(views) < 2]
    faults += [f"features.json: {name} is picked in one view only; two are needed" for name in single]
    located = locate_features(known, rig, noise_px=CLICK_PX)
    points = [point.position_world for point in located.points.values()]
    if len(points) < POINTS_LEAST:
        told = "; ".join(located.remarks)
        faults.append(
            f"features.json: {len(points)} landmarks can be located, {POINTS_LEAST} that are not on a line are needed"
            + (f" ({told})" if told else "")
        )
    elif flatness(np.stack(points)) < TRIANGLE_LEAST_MM:
        faults.append("features.json: the feature points lie on one line; pick one that does not")
    return faults


def unknown_landmarks(features: Features) -> list[str]:
    """Names that no model has."""
    unknown = sorted(set(features) - set(NAMES))[:NAMES_TOLD]
    known = ", ".join(SEVEN_POINTS)
    return [f"features.json: {name!r:.80} is no landmark (docs/models.md lists them: {known} ...)" for name in unknown]
