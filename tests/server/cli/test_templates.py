"""Commands about templates."""

import hashlib
import json
from pathlib import Path

import numpy as np
import pytest
from typer.testing import CliRunner

from pipeline.head_model.model import load_model
from rig.errors import EigenheadError, InputError
from rig.formats.meshes.ply import read_head_ply
from rig.formats.meshes.polygon_obj import read_polygons
from server.cli.main import app
from tests.server.cli.test_main import run
from tests.support.shared_data import shared
from tests.support.template_headers import header_file


def test_wrong_files_and_names_are_refused_before_anything_is_written(tmp_path: Path) -> None:
    bad = tmp_path / "bad.obj"
    bad.write_text("v 0 0 nan\n")
    here = ["--data", str(tmp_path / "data")]
    for words, kind, text in (
        (["template", "add", str(bad)], InputError, "holds no faces"),
        (["template", "add", str(bad), "--name", "../x"], EigenheadError, "cannot be a template's name"),
        (["template", "remove", "nobody"], EigenheadError, "known are none"),
    ):
        done = CliRunner().invoke(app, [*words, *here])
        assert isinstance(done.exception, kind)
        assert text in str(done.exception)
    assert not list((tmp_path / "data").rglob("*.npz"))
    assert json.loads(CliRunner().invoke(app, ["template", "list", "--json", *here]).stdout) == {"templates": {}}


def test_a_template_that_the_job_cannot_have_is_told_before_the_work(tmp_path: Path) -> None:
    """The capture is empty: what is wrong with it would be told by the first step of the work."""
    data, capture = tmp_path / "data", tmp_path / "capture"
    capture.mkdir()
    header_file(data, "foreign", model_name="other", model_sha256="ee" * 32)
    header_file(data, "damaged").write_bytes(b"PK")
    arguments = ["reconstruct", str(capture), "--out", str(tmp_path / "out"), "--data", str(data), "--template"]
    for name, text in (
        ("nobody", "known are damaged, foreign"),
        ("foreign", "registered to the model 'other'"),
        ("damaged", "Register it again"),
    ):
        done = CliRunner().invoke(app, [*arguments, name])
        assert isinstance(done.exception, EigenheadError)
        assert text in str(done.exception)
    assert not list((tmp_path / "out").glob("*"))
    listed = json.loads(CliRunner().invoke(app, ["template", "list", "--json", "--data", str(data)]).stdout)
    assert listed["templates"]["foreign"]["skin_share"] == 0.78


@pytest.mark.slow
@pytest.mark.timeout(600)
def test_a_head_is_written_in_a_templates_order(tmp_path: Path) -> None:
    """The model's own 5 % level is the foreign mesh: its vertices are vertices of head.ply."""
    model, data = load_model(), tmp_path / "data"
    level, order = model.levels["p95"], np.random.default_rng(5).permutation(model.levels["p95"].count)
    shape, faces = model.vertices(np.zeros(0), "p95")[order] / 10.0, np.argsort(order)[level.faces] + 1
    lines = [f"v {x:.5f} {y:.5f} {z:.5f}" for x, y, z in shape] + [f"f {a} {b} {c}" for a, b, c in faces]
    (tmp_path / "low.obj").write_text("\n".join(lines))
    added = run("template", "add", str(tmp_path / "low.obj"), "--json", timeout_s=600.0, EIGENHEAD_DATA=str(data))
    assert added.returncode == 0, added.stderr
    printed = json.loads(added.stdout)
    assert printed["figures"]["skin_share"] > 0.9
    assert {path.name for path in (data / "templates").iterdir()} == {"low.npz", "low.png"}
    again = run("template", "add", str(tmp_path / "low.obj"), EIGENHEAD_DATA=str(data))
    assert (again.returncode, "--overwrite" in again.stderr) == (1, True)
    arguments = ["reconstruct", str(shared("data/captures/scan-a")), "--detail", "span", "--surface", "head"]
    arguments += ["--template", "low", "--morphs", "--formats", "ply", "--out", str(tmp_path / "out")]
    done = run(*arguments, timeout_s=600.0, EIGENHEAD_DATA=str(data))
    assert done.returncode == 0, done.stderr
    head = read_head_ply(tmp_path / "out" / "head.ply")[0].vertices[level.rows[order]]
    named = json.loads((tmp_path / "out" / "report.json").read_text())["template"]
    assert (named["name"], named["source"]) == ("low", "low.obj")
    assert named["sha256"] == hashlib.sha256((tmp_path / "low.obj").read_bytes()).hexdigest()
    assert named["registration"] == pytest.approx(printed["figures"])
    written = read_polygons(tmp_path / "out" / "head-low.obj")
    assert np.median(np.linalg.norm(written.vertices - head, axis=1)) < 0.15  # chords of 9 mm sag by 0.1 mm
    with np.load(tmp_path / "out" / "head-low-shapes.npz") as file:
        names, displacements = json.loads(file["meta"].tobytes())["names"], file["displacements"]
    assert displacements.shape == (len(names), level.count, 3)
    scale = json.loads((tmp_path / "out" / "report.json").read_text())["world_from_head"]["scale"]
    true = scale * (level.operator @ model.expressions.moved({"jawOpen": 1.0}))[order]
    error = np.linalg.norm(displacements[names.index("jawOpen")] - true) / np.linalg.norm(true)
    assert error < 0.1
    assert (tmp_path / "out" / "head-low.glb").is_file()
