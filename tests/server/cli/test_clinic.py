"""The commands of a clinic, on result folders that hold what they read."""

import json
import shutil
from pathlib import Path

import numpy as np
import pytest
from typer.testing import CliRunner

from pipeline.head_model.model import load_model
from rig.mesh import Mesh
from server.cli.main import app
from tests.support.result_folders import mean_head_result

LEFT_MM = (400.0, 30.0, -50.0)  # of the rig from the head: the world frame is the head's, moved


@pytest.fixture(scope="module")
def result(tmp_path_factory: pytest.TempPathFactory) -> Path:
    model = load_model()
    mesh = Mesh(model.vertices(np.zeros(0)) + LEFT_MM, model.levels["full"].faces)
    place = {"scale": 1.0, "rotation": np.eye(3).tolist(), "translation": list(LEFT_MM)}
    breadth = {"nose_breadth": {"value": 34.0, "std": 1.0}}
    folder = tmp_path_factory.mktemp("heads") / "anna"
    return mean_head_result(folder, mesh, world_from_head=place, measurements=breadth, expression=[])


def test_an_export_says_which_plane_and_by_what(result: Path, tmp_path: Path) -> None:
    words = ["export", str(result), "--as", "slicer", "--axes", "RAS", "--plane", "frankfurt", "--out", str(tmp_path)]
    done = CliRunner().invoke(app, words)
    assert done.exit_code == 0, done.output
    assert "RAS, Frankfurt plane" in done.output
    assert "porion_left: tragion" in done.output
    frame = json.loads((tmp_path / "frame.json").read_text())
    [markup] = json.loads((tmp_path / "landmarks.mrk.json").read_text())["markups"]
    assert frame["axes"] == markup["coordinateSystem"] == "RAS"
    tragions = [np.array(p["position"]) for p in markup["controlPoints"] if p["label"].startswith("tragion")]
    np.testing.assert_allclose(tragions[0] + tragions[1], 0.0, atol=1e-9)
    assert markup["controlPoints"][0]["description"].startswith("standard deviation 3.000 mm")
    again = CliRunner().invoke(app, words)
    assert "frame.json is there already" in str(again.exception)


def test_a_hospital_s_file_has_a_pseudonym_of_letters_and_digits(result: Path, tmp_path: Path) -> None:
    words = ["export", str(result), "--as", "nifti", "--out", str(tmp_path / "out"), "--patient"]
    done = CliRunner().invoke(app, [*words, "Anna Example"])
    assert done.exit_code == 2
    assert "at most 64 letters and digits" in done.output
    done = CliRunner().invoke(app, [*words, "P017"])
    assert done.exit_code == 0, done.output
    assert {path.name for path in (tmp_path / "out").iterdir()} == {"frame.json", "sub-P017_desc-head_mask.nii.gz"}
    done = CliRunner().invoke(app, ["export", str(result), "--as", "slicer", "--axes", "XYZ", "--out", str(tmp_path)])
    assert done.exit_code == 2
    assert "not one of 'LPS', 'RAS'" in done.output


def test_a_folder_that_is_no_result_is_refused(result: Path, tmp_path: Path) -> None:
    exports = [["export", str(tmp_path), "--as", "slicer"], ["export", str(result / "head.ply"), "--as", "obj"]]
    for words in (*exports, ["compare", str(tmp_path), str(tmp_path)]):
        done = CliRunner().invoke(app, [*words, "--out", str(tmp_path / "out")])
        assert done.exit_code == 1
        assert f"{words[1]}/report.json: the file is not there: name the folder of a result" in str(done.exception)
        assert not [*(tmp_path / "out").glob("*")]


def test_a_comparison_that_is_there_is_not_written_over(result: Path, tmp_path: Path) -> None:
    (tmp_path / "compare.json").write_text("{}")
    done = CliRunner().invoke(app, ["compare", str(result), str(result), "--out", str(tmp_path)])
    assert "compare.json is there already" in str(done.exception)


def test_a_measure_comes_with_its_deviation_and_size(result: Path, tmp_path: Path) -> None:
    table = tmp_path / "sizes.toml"
    table.write_text(
        'format = "eigenhead-sizes/1"\n[[table]]\nname = "helmet"\nmeasure = "head_circumference"\n'
        "sizes = { S = [480, 540], M = [540, 600], L = [600, 660] }\n"
    )
    done = CliRunner().invoke(app, ["measure", str(result), "--sizes", str(table), "--json"])
    assert done.exit_code == 0, done.output
    document = json.loads(done.output)
    girth, bridge = (document["measures"][name] for name in ("head_circumference", "nose_bridge_width"))
    assert 0.0 < girth["std"] < 2.0 * np.pi * 0.1  # the head states 0.1 mm
    assert 8.0 < bridge["value"] < 25.0
    helmet = document["sizes"]["helmet"]
    limits = {"S": (480, 540), "M": (540, 600), "L": (600, 660)}[helmet["best"]]
    assert limits[0] <= girth["value"] < limits[1]
    report = json.loads((result / "report.json").read_text())
    doubt = {"code": "scale-assumed", "message": "an assumption", "parameters": {"scale": "an assumption"}}
    doubted = shutil.copytree(result, tmp_path / "doubted")
    (doubted / "report.json").write_text(json.dumps(report | {"scale_sigma": 0.06, "warnings": [doubt]}))
    done = CliRunner().invoke(app, ["measure", str(doubted)])
    assert "doubted: an assumption" in done.output
    table.write_text(table.read_text().replace("head_circumference", "pupil_distance"))
    done = CliRunner().invoke(app, ["measure", str(result), "--sizes", str(table)])
    assert "helmet: left out, since this result has no pupil_distance" in done.output
    table.write_text(table.read_text().replace("pupil_distance", "hat"))
    refused = CliRunner().invoke(app, ["measure", str(result), "--sizes", str(table)])
    assert "helmet: hat is not a measurement of a head" in str(refused.exception)
