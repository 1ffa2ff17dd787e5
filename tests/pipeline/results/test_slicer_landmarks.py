"""landmarks.mrk.json, against what 3D Slicer's markups schema 1.0.3 fixes, and back to the world."""

import json
from pathlib import Path

import numpy as np
import pytest

from pipeline.contour_fit.fit import Fit
from pipeline.evidence.measurements import Landmark
from pipeline.results.head_files import landmarks_document
from pipeline.results.reconstruction import Reconstruction
from pipeline.results.write import write_result
from pipeline.settings import settings_from_document
from rig.capture import Capture
from rig.geometry import Similarity, rotation_from_vector
from rig.mesh import Mesh
from server.storage.result_folder import RESULT_FILE
from tests.support.made_up_results import made_up_result
from tests.support.scenes import ellipsoid

PLACE = Similarity(1.25, rotation_from_vector(np.array([0.1, -0.3, 0.05])), np.array([12.0, -7.0, 30.0]))
HEAD_MM = {"pronasale": (0.0, -8.0, 90.0), "tragion_left": (70.0, 0.0, 0.0), "vertex": (0.0, 120.0, -5.0)}


@pytest.fixture(scope="module")
def result() -> Reconstruction:
    deviations = {"pronasale": np.array([0.3, 0.4, 1.2]), "tragion_left": None, "vertex": None}
    landmarks = {
        name: Landmark(PLACE.rotation @ np.array(place) + PLACE.translation, deviations[name])
        for name, place in HEAD_MM.items()
    }
    head = ellipsoid(2)
    fit = Fit("contour", np.array([0.5]), PLACE, 42, "the cost no longer falls")
    settings = settings_from_document({"outputs": {"slicer": True}})
    return made_up_result(Mesh(PLACE.apply(head.vertices), head.faces), fit, landmarks=landmarks, settings=settings)


def test_the_list_is_what_slicers_schema_asks_for(result: Reconstruction) -> None:
    document = json.loads(json.dumps(landmarks_document(result), allow_nan=False))
    assert set(document) == {"@schema", "markups"}
    assert document["@schema"].endswith("markups-schema-v1.0.3.json#")
    [markup] = document["markups"]
    assert markup["type"] in ("Fiducial", "Line", "Angle", "Curve", "ClosedCurve", "Plane", "ROI")
    assert (markup["type"], markup["coordinateSystem"], markup["coordinateUnits"]) == ("Fiducial", "LPS", "mm")
    for point in markup["controlPoints"]:
        assert [type(point[key]) for key in ("id", "label", "description", "positionStatus")] == [str] * 4
        assert point["positionStatus"] == "defined"
        assert len(point["position"]) == 3
        assert all(type(value) is float for value in point["position"])
    assert len({point["id"] for point in markup["controlPoints"]}) == len(HEAD_MM)


def test_axes_are_the_subjects_left_back_and_up(result: Reconstruction) -> None:
    points = {point["label"]: point for point in landmarks_document(result)["markups"][0]["controlPoints"]}
    lps = {name: point["position"] for name, point in points.items()}
    np.testing.assert_allclose(lps["tragion_left"], (70.0, 0.0, 0.0), atol=1e-9)  # left is positive
    np.testing.assert_allclose(lps["pronasale"], (0.0, -90.0, -8.0), atol=1e-9)  # the nose lies before, not behind
    np.testing.assert_allclose(lps["vertex"], (0.0, 5.0, 120.0), atol=1e-9)  # superior is up
    assert points["pronasale"]["description"].startswith("standard deviation 1.300 mm;")  # hypot(0.3, 0.4, 1.2)
    assert {points[name]["description"] for name in ("tragion_left", "vertex")} == {"standard deviation unknown"}


def test_the_written_file_leads_back_to_the_reports_landmarks(result: Reconstruction, tmp_path: Path) -> None:
    write_result(tmp_path, result, Capture({}))
    report = json.loads((tmp_path / "report.json").read_text())
    place = report["world_from_head"]
    markup = json.loads((tmp_path / "landmarks.mrk.json").read_text())["markups"][0]
    for point in markup["controlPoints"]:
        left, posterior, superior = point["position"]
        head = np.array([left, superior, -posterior])
        world = np.array(place["rotation"]) @ head + place["scale"] * np.array(place["translation"])
        np.testing.assert_allclose(world, report["landmarks"][point["label"]]["position"], atol=1e-6)
    assert RESULT_FILE.match("landmarks.mrk.json")  # so that a second run without it takes it away
