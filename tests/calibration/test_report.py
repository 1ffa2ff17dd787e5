"""One well-formed page with every camera, parameter and warning, and JSON with the rig of docs/capture-format.md."""

import json
import re
from dataclasses import replace
from xml.etree import ElementTree

import numpy as np
import pytest

from calibration.calibrate import calibrate_detections
from calibration.report import MAGNIFIED, report_page
from calibration.result import Calibration
from rig.messages.message import verbatim
from tests.support.board_sessions import session


@pytest.fixture(scope="module")
def calibration() -> Calibration:
    return calibrate_detections(session(cameras=5, shots=12, seed=4).detections)


def test_the_page_is_complete_draws_residuals_and_takes_no_text_for_markup(calibration: Calibration) -> None:
    page = report_page(calibration)
    assert not re.search(r"(src|href)\s*=|https?://|@import", page)
    for name in calibration.rig.names:
        assert page.count(f">{name}<") >= 3
    for check in calibration.checks:
        assert check.name in page
    for drawing in re.findall(r"<svg.*?</svg>", page, re.S):
        ElementTree.fromstring(drawing)
    hostile = report_page(replace(calibration, warnings=(verbatim("<script>alert(1)</script>"),)))
    assert "<script>" not in hostile
    drawn = re.findall(r"M([-\d.]+) ([-\d.]+)L([-\d.]+) ([-\d.]+)", page)
    lines = np.array(drawn, dtype=float)
    assert len(lines) == calibration.figures()["corners"]
    lengths = np.linalg.norm(lines[:, 2:] - lines[:, :2], axis=1) / MAGNIFIED
    assert np.sqrt((lengths**2).mean()) == pytest.approx(calibration.figures()["rms_px"], rel=0.01)


def test_the_json_keeps_the_contract(calibration: Calibration) -> None:
    document = json.loads(json.dumps(calibration.document()))
    figures = document["figures"]
    assert {"rms_px", "used_share", "cameras"} <= figures.keys()
    assert all("rms_px" in figures["cameras"][name] for name in calibration.rig.names)
    assert 0.0 < figures["used_share"] <= 1.0
    assert document["rig"]["format"] == "eigenhead-cameras/1"
