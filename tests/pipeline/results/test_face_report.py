"""``faces`` of report.json: of each camera whether the subject's face was found, its box, roll, landmarks and score."""

import numpy as np
import pytest

from pipeline.faces.matching import complete_match
from pipeline.faces.subject import SubjectFaces
from pipeline.faces.triangulated_face import triangulate_face
from pipeline.results import report
from pipeline.results.report_types import FaceReport
from rig.geometry import Similarity
from tests.support.drawn_faces import seen_face
from tests.support.drawn_studio import drawn_studio


def test_each_camera_has_its_face_and_nothing_else() -> None:
    rig, rng = drawn_studio(), np.random.default_rng(3)
    placed = Similarity(1.0, np.eye(3), np.zeros(3))
    detections = {name: seen_face(placed, rig[name], rng, score=31.5) for name in ("cam0", "cam1", "cam2")}
    face = triangulate_face(detections, rig)
    assert face is not None
    subject = SubjectFaces({"cam3": (), **{n: (d,) for n, d in detections.items()}}, complete_match(face, {}, rig), ())
    found = report._faces(subject, rig.names)
    assert list(found) == list(rig.names)
    for name, of_camera in found.items():
        assert of_camera.keys() == FaceReport.__annotations__.keys()
        assert of_camera.keys() == {"found", "box_px", "roll_deg", "landmarks", "score"}
        assert of_camera["found"] == (name in detections)
    assert found["cam0"]["landmarks"] == 468
    assert found["cam0"]["score"] == 31.5
    assert found["cam0"]["box_px"] == pytest.approx(detections["cam0"].box_px.tolist())
    assert found["cam5"] == {"found": False, "box_px": None, "roll_deg": None, "landmarks": 0, "score": None}


def test_where_views_do_not_agree_no_camera_has_the_subject() -> None:
    rig, rng = drawn_studio(), np.random.default_rng(3)
    seen = {"cam0": (seen_face(Similarity(1.0, np.eye(3), np.zeros(3)), rig["cam0"], rng),)}
    assert not any(one["found"] for one in report._faces(SubjectFaces(seen, None, ()), rig.names).values())
