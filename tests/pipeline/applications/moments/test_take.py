"""``eigenhead take``: two small captures of one bald head in the studio, run through the command."""

import json
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from typer.testing import CliRunner

from pipeline.head_model.model import HeadModel
from rig.formats.captures.capture_folder import write_capture
from rig.formats.meshes.mesh_file import read_mesh
from rig.formats.pictures.work_size import work_rig
from rig.mesh import Mesh
from rig.render.renderer import Renderer
from rig.studio.scene.layout import default_layout
from rig.studio.scene.simulate import simulate
from rig.studio.scene.subject import Subject, random_look
from server.cli.main import app
from tests.support.small_studio import CLEAN

PIXELS = 240 * 180
EXPRESSIONS = {"calm": {}, "smile": {"mouthSmileLeft": 0.8, "mouthSmileRight": 0.8}}


@pytest.fixture(scope="module")
def shots(model: HeadModel, renderer: Renderer, tmp_path_factory: pytest.TempPathFactory) -> Path:
    folder = tmp_path_factory.mktemp("shots")
    rig = work_rig(default_layout().subset(["cam00", "cam03", "cam04"]), PIXELS)
    rng = np.random.default_rng(12)
    identity, look = 0.8 * rng.standard_normal(60), random_look(rng)
    for name, weights in EXPRESSIONS.items():
        head, full = model.posed_vertices(identity, weights), model.levels["full"]
        marks = {mark: head[row] for mark, row in model.landmarks.items()}
        sitter = Subject(Mesh(head, full.faces), marks, full.face_region, name)
        preset = replace(CLEAN, noise=0.01, plates=2, texture=False)
        taken = simulate(sitter, rig, preset, rng, renderer=renderer, look=look)
        write_capture(folder / name, replace(taken.capture, features={}), taken.rig)
    return folder


@pytest.fixture(scope="module")
def done(shots: Path, tmp_path_factory: pytest.TempPathFactory) -> tuple[Path, dict[str, Any]]:
    out = tmp_path_factory.mktemp("take")
    words = ["take", *(str(shots / name) for name in EXPRESSIONS), "--out", str(out), "--detail", "kernel", "--json"]
    result = CliRunner().invoke(app, words)
    assert result.exit_code == 0, result.output
    return out, json.loads(result.stdout)


def test_the_folder_has_the_person_and_every_moment(done: tuple[Path, dict[str, Any]], model: HeadModel) -> None:
    out, document = done
    assert document == json.loads((out / "report.json").read_text())
    assert [each["name"] for each in document["moments"]] == [*EXPRESSIONS]
    neutral, faces = read_mesh(out / "neutral.ply"), model.levels["full"].faces
    assert np.array_equal(neutral.faces, faces)
    for name in EXPRESSIONS:
        assert np.array_equal(read_mesh(out / "moments" / name / "head.ply").faces, faces)
    with np.load(out / "take.npz") as kept, np.load(out / "shapes.npz") as shapes:
        assert kept["heads"].shape == (2, len(neutral.vertices), 3)
        assert kept["weights"].shape == kept["weight_deviations"].shape == (2, len(model.expressions))
        assert shapes["shapes"].shape == (52, len(neutral.vertices), 3)
        apart = np.linalg.norm(kept["heads"][0] - neutral.vertices, axis=1)
        smile = kept["weights"][1, list(kept["expressions"]).index("mouthSmileLeft")]
    assert apart[model.levels["full"].face_region].mean() < 0.3  # calm is neutral
    assert smile > 0.3
    reported = {each["name"]: each["weights"] for each in document["moments"]}
    assert reported["smile"]["mouthSmileLeft"]["weight"] == pytest.approx(smile)
    assert sum(of["weight"] for of in reported["calm"].values()) < 0.2


def test_one_capture_is_no_take(shots: Path, tmp_path: Path) -> None:
    result = CliRunner().invoke(app, ["take", str(shots / "calm"), "--out", str(tmp_path / "one")])
    assert result.exit_code == 2
    assert "1 capture was given" in result.output
    assert not (tmp_path / "one").exists()


def test_two_of_one_name_are_refused(shots: Path, tmp_path: Path) -> None:
    words = ["take", str(shots / "calm"), str(shots / "calm"), "--out", str(tmp_path / "two")]
    result = CliRunner().invoke(app, words)
    assert result.exit_code == 2
    assert "calm" in result.output


def test_what_fails_in_a_moment_names_it(shots: Path, tmp_path: Path) -> None:
    lone = tmp_path / "lone"
    (lone / "images").mkdir(parents=True)
    (lone / "cameras.json").write_bytes((shots / "calm" / "cameras.json").read_bytes())
    result = CliRunner().invoke(app, ["take", str(shots / "calm"), str(lone), "--out", str(tmp_path / "out")])
    assert result.exit_code == 1
    assert "lone" in str(result.exception)
