"""The papers of a verification: what report.json holds, and that the certificate is two pages that repeat."""

import json
from dataclasses import replace
from pathlib import Path

import numpy as np

from pipeline.applications.verification.judgement import Limits, judge
from pipeline.applications.verification.measured import ResultIdentity
from pipeline.applications.verification.reference import Reference
from pipeline.applications.verification.report import Occasion, report_document
from pipeline.applications.verification.write import certificate_pdf, draw, heat_colours, scale_end, write_verification
from pipeline.results.pdf_page import latin
from rig.formats.pictures.images import read_image
from tests.support.measured_heads import mannequin, marks, measured_head

OCCASION = Occasion("2026-01-31", ResultIdentity("tiny", "0" * 64), Limits(face_rms_mm=0.01))
SCAN = Reference.of(mannequin(), marks(), "scan.ply")


def test_a_missed_limit_is_on_both_papers(tmp_path: Path) -> None:
    wider = measured_head(1.004 * mannequin().vertices, "wider")
    judgement = judge([wider], SCAN, OCCASION.limits)
    document = write_verification(tmp_path, wider, SCAN, judgement, OCCASION)
    kept = json.loads((tmp_path / "report.json").read_text())
    assert kept == json.loads(json.dumps(document))
    assert kept["passed"] is False
    assert kept["checks"]["face_rms_mm"]["passed"] is False
    assert kept["checks"]["repeatability_mm"] == {"value": None, "limit": Limits().repeatability_mm, "passed": None}
    captured = kept["captures"]["wider"]
    assert captured["size_error_percent"] == captured["alignment"]["size_error_percent"]
    assert abs(captured["size_error_percent"] - 0.4) < 0.01
    pdf = (tmp_path / "certificate.pdf").read_bytes()
    assert pdf.startswith(b"%PDF")
    assert pdf.count(b"/Type /Page\n") == 2
    assert read_image(tmp_path / "error.png").std() > 10


def test_the_same_report_gives_the_same_bytes_and_many_captures_fit() -> None:
    one = measured_head()
    judgement = judge([one], SCAN, OCCASION.limits)
    many = replace(judgement, captures=tuple(replace(judgement.captures[0], name=f"žluť {i}") for i in range(12)))
    document, pictures = report_document(many, SCAN, OCCASION), draw(one, SCAN, judgement)
    first = certificate_pdf(document, many, pictures)
    assert first == certificate_pdf(document, many, pictures)
    assert first.count(b"/Type /Page\n") == 2
    assert latin("žluť") == "?lu?"


def test_colours_say_which_side_and_where_nothing_is_known() -> None:
    blue, white, red, grey = heat_colours(np.array([-9.0, 0.0, 0.5, np.nan]), 0.5).astype(int)
    assert blue[2] > blue[0]
    assert red[0] > red[2]
    assert white.min() > 240
    assert np.ptp(grey) == 0
    assert scale_end(np.linspace(-0.21, 0.21, 1000)) == 0.2
    assert scale_end(np.array([np.nan, 30.0])) == 5.0
