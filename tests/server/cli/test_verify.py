"""`eigenhead verify`: faults before any work, results taken as they are, a missed limit is status 1."""

import json
from pathlib import Path

import numpy as np
import pytest

from pipeline.applications.verification.judgement import Limits
from pipeline.head_model.model import load_model
from rig.errors import InputError
from rig.geometry import RigidTransform, rotation_from_vector
from rig.mesh import Mesh
from server.cli.heads import read_limits, verify_captures
from tests.server.cli.test_main import run
from tests.support.glb import obj_bytes
from tests.support.landmark_files import write_landmarks
from tests.support.measured_heads import mannequin
from tests.support.result_folders import mean_head_result
from tests.support.services import small_capture

SCAN_FROM_HEAD = RigidTransform(rotation_from_vector(np.array([0.4, -1.0, 0.2])), np.array([80.0, 900.0, -50.0]))


def judged(captures: list[Path], reference: Path, out: Path) -> None:
    verify_captures(
        captures, out, reference=reference, landmarks=None, model=None, settings={}, limits=Limits(),
        report=lambda stage, fraction: None,
    )  # fmt: skip


def test_a_bad_reference_is_named_before_anything_is_reconstructed(tmp_path: Path) -> None:
    capture, scan = small_capture(tmp_path / "shot"), tmp_path / "scan.obj"
    scan.write_bytes(obj_bytes(Mesh(mannequin().vertices / 10, mannequin().faces)))
    with pytest.raises(InputError, match=r"scan\.obj: .* which is a head in cm"):
        judged([capture], scan, tmp_path / "out")
    with pytest.raises(InputError, match="more than one is called shot"):
        judged([capture, tmp_path / "other" / "shot"], scan, tmp_path / "out")
    assert not (tmp_path / "out").exists()


def test_limits_come_from_a_file(tmp_path: Path) -> None:
    (tmp_path / "limits.toml").write_text("face_rms_mm = 0.2\n")
    assert read_limits(tmp_path / "limits.toml") == Limits(face_rms_mm=0.2)
    assert read_limits(None) == Limits()
    (tmp_path / "limits.json").write_text('{"faces": 1}')
    with pytest.raises(InputError, match=r"limits\.json: unknown key 'faces'"):
        read_limits(tmp_path / "limits.json")


def planted_result(folder: Path, scale: float) -> Path:
    """What a reconstruction of the mean head leaves, ``scale`` times too large."""
    model = load_model()
    return mean_head_result(folder, Mesh(scale * model.vertices(np.zeros(0)), model.levels["full"].faces))


@pytest.mark.slow
def test_results_are_judged_as_they_are_and_a_missed_limit_is_status_1(tmp_path: Path) -> None:
    model = load_model()
    scan = SCAN_FROM_HEAD.apply(model.vertices(np.zeros(0)))
    (tmp_path / "scan.obj").write_bytes(obj_bytes(Mesh(scan, model.levels["full"].faces)))
    write_landmarks(tmp_path / "scan.json", {name: scan[row] for name, row in model.landmarks.items()})
    right, wrong = planted_result(tmp_path / "right", 1.0), planted_result(tmp_path / "wrong", 1.01)
    options = ("--reference", str(tmp_path / "scan.obj"), "--out", str(tmp_path / "out"), "--json", "--overwrite")
    good = run("verify", str(right), *options, timeout_s=280.0)
    assert (good.returncode, good.stderr) == (0, "")
    assert json.loads(good.stdout) == json.loads((tmp_path / "out" / "report.json").read_text())
    bad = run("verify", str(right), str(wrong), *options, timeout_s=280.0)
    assert bad.returncode == 1
    assert "size_error_percent is 1, the limit is 0.3" in bad.stderr
    assert bad.stderr.count("\n") == 1
    found = json.loads(bad.stdout)
    assert found["captures"]["wrong"]["size_error_percent"] == pytest.approx(1.0, abs=1e-2)
    assert found["captures"]["right"]["regions"]["face"]["rms_mm"] < 0.005
    assert {"certificate.pdf", "error.png", "report.json"} <= {path.name for path in (tmp_path / "out").iterdir()}
