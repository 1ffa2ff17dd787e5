"""Photographs of the wedge alone: calibrated once, kept, and taken again when one of them is another."""

import json
import shutil
from pathlib import Path

import numpy as np
import pytest
from typer.testing import CliRunner

from calibration.adjustment.gauge import image_distance
from rig.formats.cameras.cameras_json import write_rig
from rig.formats.pictures.images import read_image, write_image
from rig.progress import discard_progress
from server.cli.main import app
from server.tasks.photographs import photographs_alone, read_or_calibrate
from tests.support.shared_data import shared
from tests.support.textured_wedge import wedge_rig, write_photographs


@pytest.mark.slow
def test_photographs_alone_become_a_capture_and_are_kept(tmp_path: Path) -> None:
    photos, kept = write_photographs(tmp_path / "photos", wedge_rig()), tmp_path / "out"
    stages: list[str] = []
    found = read_or_calibrate(photos, kept, front="cam02", report=lambda stage, share: stages.append(stage))
    assert set(found.rig.names) == set(found.capture.images) == set(wedge_rig().names)
    assert image_distance(found.rig, wedge_rig(), scale=True).max() < 0.1
    assert [warning.code for warning in found.warnings] == ["scale-assumed"]
    assert {"cameras.json", "calibration.json", "calibration.html"} <= {path.name for path in kept.iterdir()}
    assert "structure" in stages

    stages.clear()
    again = read_or_calibrate(photos, kept, front="cam02", report=lambda stage, share: stages.append(stage))
    assert stages == []  # nothing was worked out again
    assert again.capture.digests == found.capture.digests
    assert again.warnings == found.warnings

    picture = np.array(read_image(photos / "cam00.png"))
    write_image(photos / "cam00.png", np.ascontiguousarray(255 - picture))
    read_or_calibrate(photos, kept, front="cam02", report=lambda stage, share: stages.append(stage))
    assert "structure" in stages


@pytest.mark.slow
@pytest.mark.gl
@pytest.mark.timeout(600)
def test_lengths_of_an_assumed_scale_hold_what_they_state(tmp_path: Path) -> None:
    """Of the same landmarks as with the true cameras, whose head is .1 mm off."""
    calibrated, reports = shared("data/captures/scan-a"), []
    shutil.copytree(calibrated, tmp_path / "photos", ignore=lambda *_: ["cameras.json"])
    for number, folder in enumerate((calibrated, tmp_path / "photos")):
        options = ["--detail", "span", "--surface", "head", "--out", str(tmp_path / f"{number}")]
        done = CliRunner().invoke(app, ["reconstruct", str(folder), *options])
        assert done.exit_code == 0, done.output
        reports.append(json.loads((tmp_path / f"{number}/report.json").read_text()))
    true, assumed = reports
    assert "scale-assumed" in {warning["code"] for warning in assumed["warnings"]}
    assert len(true["measurements"]) >= 17
    for name, length in assumed["measurements"].items():
        assert abs(length["value"] - true["measurements"][name]["value"]) < 1.96 * length["std"], name


def test_a_folder_with_cameras_is_read_as_it_is(tmp_path: Path) -> None:
    write_photographs(tmp_path, wedge_rig())
    assert photographs_alone(tmp_path)
    write_rig(wedge_rig(), tmp_path / "cameras.json")
    assert not photographs_alone(tmp_path)
    found = read_or_calibrate(tmp_path, tmp_path / "out", front=None, report=discard_progress)
    assert found.warnings == ()
    assert image_distance(found.rig, wedge_rig(), scale=False).max() < 1e-6
    assert not (tmp_path / "out").exists()


@pytest.mark.parametrize(
    ("inside", "found"), [("a.png", True), ("images/a/1.png", True), ("home/user/2019/a.png", False)]
)
def test_photographs_are_looked_for_where_they_are_read(tmp_path: Path, inside: str, found: bool) -> None:
    """Deeper is somebody's disk, not a capture."""
    (tmp_path / "beside").mkdir()
    (tmp_path / inside).parent.mkdir(parents=True, exist_ok=True)
    (tmp_path / inside).write_bytes(b"")
    assert photographs_alone(tmp_path) == found
