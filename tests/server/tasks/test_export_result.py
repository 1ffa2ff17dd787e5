"""A finished result in every other format, beside what a job writes."""

import json
import zipfile
from dataclasses import replace
from pathlib import Path

import cv2
import numpy as np
import pytest
import trimesh
from typer.testing import CliRunner

from pipeline.applications.templates.write.writers import load_template_writers
from pipeline.evidence.expression import Found, build_blendshape_rig
from pipeline.head_model.expressions import Expressions
from pipeline.head_model.model import load_model
from pipeline.results.write import write_result
from pipeline.settings import OutputSettings, Settings
from pipeline.texturing.layout.uv_unwrap import Atlas, model_layout
from rig.capture import Capture
from rig.errors import InputError
from rig.mesh import Mesh
from rig.progress import discard_progress
from server.cli.main import app
from server.tasks.child import WorkerContext
from server.tasks.export_archive import export_archive
from server.tasks.export_result import export_result
from tests.support.glb import opened_glb
from tests.support.made_up_results import textured_result

FORMATS = ("glb", "ply", "obj", "stl", "3mf")


@pytest.fixture(scope="module")
def folder(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """What a job writes of the mean head with a smile, its texture red at the left and blue at the right."""
    model, folder = load_model(), tmp_path_factory.mktemp("result")
    image = np.zeros((1024, 1024, 3), np.uint8)
    image[:, :512], image[:, 512:] = (200, 30, 30), (30, 30, 200)
    mesh = Mesh(model.vertices(np.zeros(0)), model.levels["full"].faces)
    made = textured_result(mesh, Atlas(model_layout(model).layout, image))
    found = (Found("mouthSmileLeft", 0.6, None),)
    shapes = build_blendshape_rig(model, made.head.fit.world_from_head, made.mesh_world, found)
    made = replace(
        made,
        model_name="default",
        settings=Settings(outputs=OutputSettings(surface="head", formats=FORMATS, morphs=True)),
        evidence=replace(made.evidence, expression=found, blendshape_rig=shapes),
    )
    write_result(folder, made, Capture({}), load_template_writers(None, model))
    return folder


def exported(folder: Path, out: Path, form: str, *options: str) -> list[str]:
    called = CliRunner().invoke(app, ["export", str(folder), "--as", form, "--out", str(out), "--json", *options])
    assert called.exit_code == 0, called.exception
    return json.loads(called.stdout)["files"]


@pytest.mark.slow
@pytest.mark.parametrize("form", ["glb", "ply", "obj", "stl"])
def test_a_format_is_the_file_that_the_job_wrote(form: str, folder: Path, tmp_path: Path) -> None:
    """Vertices pass through head.ply's float32 (30 nm at half a metre) and stay within the last written digit; the
    texture passes through head.png, without loss."""
    files = exported(folder, tmp_path, form)
    assert f"head.{form}" in files
    assert set(files) <= {f"head.{form}", "head.mtl", "head.png"}
    ours, theirs = (trimesh.load(place / f"head.{form}", process=False, force="mesh") for place in (tmp_path, folder))
    assert isinstance(ours, trimesh.Trimesh)
    assert isinstance(theirs, trimesh.Trimesh)
    unit = 1000.0 if form == "glb" else 1.0
    np.testing.assert_array_equal(ours.faces, theirs.faces)
    np.testing.assert_allclose(unit * ours.vertices, unit * theirs.vertices, atol=2e-4)
    if form == "obj":
        ours_png, theirs_png = (np.asarray(cv2.imread(str(place / "head.png"))) for place in (tmp_path, folder))
        np.testing.assert_array_equal(ours_png, theirs_png)


@pytest.mark.slow
def test_shapes_and_albedo_need_no_new_job(folder: Path, tmp_path: Path) -> None:
    files = exported(folder, tmp_path, "glb", "--morphs", "--albedo")
    assert set(files) == {"head.glb", "posed.glb", "texture/albedo.png"}
    (ours, _), (theirs, _) = (opened_glb((place / "posed.glb").read_bytes()) for place in (tmp_path, folder))
    assert [node["name"] for node in ours["nodes"]] == [node["name"] for node in theirs["nodes"]]
    head = ours["meshes"][0]
    assert head["extras"] == theirs["meshes"][0]["extras"]
    weights = dict(zip(head["extras"]["targetNames"], head["weights"], strict=True))
    assert {name: weight for name, weight in weights.items() if weight} == {"mouthSmileLeft": 0.6}
    assert {"eye_left", "eye_right", "teeth_upper", "teeth_lower", "tongue"} < {node["name"] for node in ours["nodes"]}
    assert "tongueOut" not in head["extras"]["targetNames"]
    tongue = next(mesh for mesh in ours["meshes"] if mesh["name"] == "tongue")
    assert "tongueOut" in tongue["extras"]["targetNames"]


@pytest.mark.slow
def test_an_archive_holds_the_files_of_an_export(folder: Path, tmp_path: Path) -> None:
    outputs, archive = {"formats": ["obj"], "template": None, "albedo": "none"}, tmp_path / "export.zip"
    export_archive(WorkerContext(), discard_progress, result=str(folder), archive=str(archive), outputs=outputs)
    files = exported(folder, tmp_path / "obj", "obj")
    with zipfile.ZipFile(archive) as packed:
        assert {name: packed.read(name) for name in packed.namelist()} == {
            name: (tmp_path / "obj" / name).read_bytes() for name in files
        }
    assert [path.name for path in tmp_path.iterdir() if path.is_dir()] == ["obj"]  # what was packed is gone


def test_shapes_of_a_model_without_expressions_are_refused(monkeypatch: pytest.MonkeyPatch, tmp_path: Path) -> None:
    rigid = replace(load_model(), expressions=Expressions((), np.zeros((0, 1, 3), np.float32)))
    monkeypatch.setattr("server.tasks.export_result.load_model", lambda _: rigid)
    (tmp_path / "report.json").write_text(json.dumps({"model": {"name": rigid.name, "sha256": rigid.sha256}}))
    with pytest.raises(InputError, match="cannot be written, because the model makehuman-138 has no expressions"):
        export_result(tmp_path, tmp_path / "out", OutputSettings(formats=("glb",), morphs=True))
