"""The command that wraps scans."""

from pathlib import Path

import numpy as np
import pytest
import trimesh
from typer.testing import CliRunner

from pipeline.applications.templates.header import new_path
from pipeline.applications.templates.template_file import save_template
from pipeline.head_model.model import load_model
from rig.errors import EigenheadError, InputError
from server.cli.main import app
from tests.support.ready_templates import ready_template


@pytest.fixture
def data(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Path:
    monkeypatch.setenv("EIGENHEAD_DATA", str(tmp_path / "data"))
    path = new_path("low")
    path.parent.mkdir(parents=True)
    save_template(path, ready_template(load_model()))
    return tmp_path


def wrap(scan: Path, *words: str) -> BaseException | None:
    return CliRunner().invoke(app, ["wrap", str(scan), "--out", str(scan.parent / "out"), *words]).exception


def test_what_cannot_be_wrapped_is_told_before_anything_is_written(data: Path) -> None:
    trimesh.PointCloud(np.eye(3)).export(data / "points.ply")
    (data / "points.json").write_text('{"points": {"pronasale": [0, 0, 0]}}')
    for words, kind, text in (
        (["--template", "nobody"], EigenheadError, "known are low"),
        (["--template", "low"], InputError, "points.ply: the mesh holds no triangles"),
        (["--template", "low", "--landmarks", str(data / "points.json")], InputError, "holds no triangles"),
    ):
        fault = wrap(data / "points.ply", *words)
        assert isinstance(fault, kind)
        assert text in str(fault)
    assert not [*(data / "out").glob("*")]


def test_a_wrapped_scan_is_not_written_over(data: Path) -> None:
    (data / "out").mkdir()
    (data / "out" / "wrapped.obj").write_text("mine")
    (data / "scan.ply").write_text("")
    fault = wrap(data / "scan.ply", "--template", "low")
    assert isinstance(fault, EigenheadError)
    assert "--overwrite" in str(fault)
    assert (data / "out" / "wrapped.obj").read_text() == "mine"
