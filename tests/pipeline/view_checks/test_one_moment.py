"""Views of another moment are named, with how far: a mean face's landmarks, moved in one camera by a known distance."""

import numpy as np
import pytest

from pipeline.faces.detection import FaceDetection
from pipeline.faces.matching import complete_match, find_subject_face
from pipeline.faces.points import direction_from_face, point_table, view_bias
from pipeline.faces.subject import SubjectFaces
from pipeline.view_checks.one_moment import LOWER_LIP, judge_moments
from rig.geometry import Similarity
from rig.studio.scene.layout import default_layout

FIVE = default_layout().scaled(0.5).subset(["cam00", "cam03", "cam04", "cam05", "cam06"])
STILL = (0.0, 0.0, 0.0)
AT_ORIGIN = Similarity(1.0, np.eye(3), np.zeros(3))


@pytest.mark.parametrize(
    ("moved_mm", "rows", "named"),
    [(STILL, slice(None), []), ((0.0, 10.0, 0.0), slice(None), ["cam03"]), ((0.0, -12.0, 0.0), LOWER_LIP, ["cam03"])],
    ids=["clean", "head", "mouth"],
)
def test_a_view_of_another_moment_is_named(moved_mm, rows, named) -> None:
    found = {}
    for camera in FIVE:
        points = point_table().shape_mm.copy()
        points[rows] += moved_mm if camera.name == "cam03" else STILL
        pixels = camera.project(points)
        size_px = float(np.ptp(pixels[:, 1]))
        pixels += size_px * view_bias(direction_from_face(AT_ORIGIN, camera))
        box = np.concatenate([pixels.min(axis=0), pixels.max(axis=0)])
        found[camera.name] = (FaceDetection(pixels, 40.0, box, 0.0),)
    best = find_subject_face(found, FIVE, None)
    warnings = judge_moments(SubjectFaces(found, best and complete_match(best, found, FIVE), FIVE.names), FIVE)
    assert [warning.parameters["camera"] for warning in warnings] == named
    # The camera looks down at the face: a vertical step is seen shortened.
    offsets_mm = np.array([warning.parameters["offset_mm"] for warning in warnings], float)
    assert ((offsets_mm > 0.6 * np.linalg.norm(moved_mm)) & (offsets_mm < 1.1 * np.linalg.norm(moved_mm))).all()
