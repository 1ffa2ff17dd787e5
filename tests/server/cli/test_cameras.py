"""``eigenhead calibrate --from scene``: what it writes and says, what it refuses, and which options go together."""

import json
import re
import shutil
import tomllib
from pathlib import Path

import numpy as np
import pytest
from scipy.spatial.distance import pdist
from typer.testing import CliRunner

from calibration.board.board import board_poses, photograph_board, write_board
from rig.formats.cameras.cameras_file import FOLDER_FORMATS, FORMATS, write_rig_file
from rig.formats.cameras.cameras_json import read_rig
from rig.formats.pictures.images import write_image
from server.cli.main import app
from server.http.schemas import NewCalibration
from tests.server.cli.test_main import run
from tests.support.board_sessions import CHARUCO, rig_of
from tests.support.services import ROOT
from tests.support.textured_wedge import wedge_rig, write_photographs


@pytest.mark.slow
def test_the_studio_shows_an_own_board_that_gives_its_cameras(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr("server.cli.simulate.BOARD_SHOTS", 8)
    shots, out = tmp_path / "shots", tmp_path / "cameras.json"
    printed = CliRunner().invoke(app, ["board", "--squares=10x7", "--square-mm=40", f"--out={tmp_path}/own.pdf"])
    assert "paper of 420 x 594 mm" in printed.stdout
    assert CliRunner().invoke(app, ["simulate", str(shots), f"--board-file={tmp_path}/board.toml"]).exit_code == 0
    for folder in sorted(shots.glob("cam*"))[6:]:  # six cameras show it as well as eleven
        shutil.rmtree(folder)
    assert run("calibrate", str(shots), f"--board={shots}/board.toml", f"--out={out}", "--anyway").returncode == 0
    calibrated, studio = read_rig(out), read_rig(tmp_path / "shots.truth" / "cameras.json")
    true = pdist([studio[name].centre_world for name in calibrated.names])
    # Corners are found to 0.05 px, 0.03 mm at the board; the focal length of 8 views to 0.3 px, 0.2 mm of depth.
    np.testing.assert_allclose(pdist([camera.centre_world for camera in calibrated]), true, atol=1.0)


@pytest.mark.slow
def test_photographs_become_cameras_and_a_page(tmp_path: Path) -> None:
    photos = write_photographs(tmp_path / "photos", wedge_rig().subset(["cam00", "cam01", "cam02"]))
    out = tmp_path / "new" / "cameras.json"
    done = run("calibrate", str(photos), "--from", "scene", "--out", str(out), "--json")
    assert done.returncode == 0, done.stderr
    printed = json.loads(done.stdout)
    assert set(printed["figures"]["cameras"]) == {"cam00", "cam01", "cam02"}
    assert {"rms_px", "used_share"} <= set(printed["figures"])
    assert printed["scale"]["assumed"]
    assert "ASSUMPTION" in done.stderr
    assert all(camera.covariance is not None for camera in read_rig(out))
    assert "3 of 3 views joined" in out.with_suffix(".html").read_text()


def test_faults_of_scale_json_end_it_before_the_work(tmp_path: Path) -> None:
    for name in "abc":
        (tmp_path / f"{name}.png").write_bytes(b"")
    (tmp_path / "scale.json").write_text(json.dumps({"cameras": ["a", "d"], "distance_mm": -1}))
    done = run("calibrate", f"{tmp_path}", "--from=scene", f"--scale={tmp_path}/scale.json", f"--out={tmp_path}/c.json")
    assert done.returncode == 1
    assert "distance_mm is -1" in done.stderr
    assert "cameras names 'd'" in done.stderr
    assert not (tmp_path / "c.json").exists()


def test_cameras_that_take_no_part_are_told_where_a_file_is_converted(tmp_path: Path) -> None:
    write_rig_file(wedge_rig(), tmp_path / "rig.xml", "metashape")
    text = (tmp_path / "rig.xml").read_text()
    name = wedge_rig().names[0]
    (tmp_path / "rig.xml").write_text(text.replace(f'label="{name}">', f'label="{name}" enabled="false">'))
    done = CliRunner().invoke(app, ["convert", str(tmp_path / "rig.xml"), "--out", str(tmp_path / "out.json")])
    assert done.exit_code == 0, done.output
    assert f'view-left-out: not every view is used: {name} switched off (enabled="false") in rig.xml' in done.stderr
    assert f"{len(wedge_rig()) - 1} cameras" in done.stdout


def test_formats_of_several_files_are_told_from_those_of_one(tmp_path: Path) -> None:
    for kind in FORMATS:
        write_rig_file(wedge_rig(), tmp_path / kind, kind)
        assert (tmp_path / kind).is_dir() == (kind in FOLDER_FORMATS), kind


def test_one_board_is_the_default_of_command_page_and_documents(tmp_path: Path) -> None:
    assert CliRunner().invoke(app, ["board", "--out", str(tmp_path / "board.pdf")]).exit_code == 0
    written = tomllib.loads((tmp_path / "board.toml").read_text())
    text, script = (ROOT / name for name in ("docs/calibration.md", "server/console/pages/calibration.js"))
    document = tomllib.loads("\n".join(re.findall(r"^    (\w+ = .*)$", text.read_text(), re.MULTILINE)[:6]))
    page = dict(re.findall(r"^      (\w+): (.*),$", script.read_text(), re.MULTILINE))
    schema = NewCalibration.model_json_schema()
    assert schema["examples"][0]["board"].items() <= written.items()
    assert document.items() <= written.items()
    for key in ("kind", "columns", "rows", "square_mm"):
        assert json.loads(page[key]) == written[key] == document[key]


def test_intrinsics_only_needs_no_common_moments(tmp_path: Path) -> None:
    """Each camera has shots of its own names; the lenses are within five of their standard deviations of the truth."""
    rng = np.random.default_rng(4)
    rig = rig_of(2, rng)
    write_board(CHARUCO, tmp_path / "board.toml")
    for camera in rig:
        for shot, pose in enumerate(board_poses(CHARUCO, 16, rng)):
            path = tmp_path / "shots" / camera.name / f"{camera.name}-{shot}.png"
            write_image(path, photograph_board(CHARUCO, pose, camera, rng))
    out = tmp_path / "lenses.json"
    words = ["calibrate", str(tmp_path / "shots"), "--board", str(tmp_path / "board.toml"), "--out", str(out)]
    done = run(*words, "--intrinsics-only", "--json")
    assert done.returncode == 0, done.stderr
    document = json.loads(out.read_text())
    assert document == json.loads(done.stdout)
    for held in document["cameras"]:
        k = rig[held["name"]].intrinsics
        found = np.array([held["intrinsics"][name] for name in ("fx", "fy", "cx", "cy")])
        assert (np.abs(found - [k.fx, k.fy, k.cx, k.cy]) < 5.0 * np.array(held["sigma"][:4])).all()
        assert held["rms_px"] < 0.3
