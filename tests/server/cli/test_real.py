"""``eigenhead experiments real``: what its folders may hold, and what is wrong usage."""

import json
from pathlib import Path

import numpy as np
import pytest
from typer.testing import CliRunner

from rig.errors import InputError
from rig.formats.cameras.cameras_json import read_rig
from rig.formats.pictures.images import write_image
from server.cli.main import app
from tests.laboratory.experiments.judge_real import judge_folders, read_real_capture
from tests.support.services import small_capture


def quiet(stage: str, share: float) -> None:
    pass


def outlines(path: Path, *names: str) -> Path:
    square = [[[4, 4], [12, 4], [12, 12], [4, 12]]]
    document = {"format": "eigenhead-outlines/1", "outlines": dict.fromkeys(names, square)}
    path.write_text(json.dumps(document))
    return path


def test_outlines_and_masks_of_a_folder_judge_it(tmp_path: Path) -> None:
    folder = small_capture(tmp_path / "anna")
    write_image(folder / "masks" / "cam00.png", np.pad(np.full((12, 12), 255, np.uint8), 6))
    outlines(folder / "outlines.json", "cam01", "cam07")
    capture = read_real_capture(folder, tmp_path / "kept", "cam02", None, quiet)
    assert (capture.name, capture.front, capture.rig.names) == (
        "anna",
        "cam02",
        read_rig(folder / "cameras.json").names,
    )
    assert set(capture.drawn) == {"cam00", "cam01"}
    assert capture.drawn["cam00"].sum() == 144
    assert capture.drawn["cam01"].sum() == pytest.approx(81, abs=2)
    other = read_real_capture(folder, tmp_path / "kept", None, outlines(tmp_path / "other.json", "cam02"), quiet)
    assert set(other.drawn) == {"cam00", "cam02"}
    assert not (tmp_path / "kept").exists(), "the cameras were given"


def test_wrong_usage_is_told_before_anything_is_loaded(tmp_path: Path) -> None:
    folder = small_capture(tmp_path / "anna")
    run = CliRunner().invoke
    nowhere = run(app, ["experiments", "real", str(folder), str(tmp_path / "nobody")])
    assert nowhere.exit_code == 2
    assert "nobody: no such folder" in " ".join(nowhere.stderr.replace("│", " ").split())
    none = run(app, ["experiments", "real"])
    assert none.exit_code == 2
    assert "name the folders of the photographs" in " ".join(none.stderr.replace("│", " ").split())
    other = run(app, ["experiments", "views", str(folder)])
    assert other.exit_code == 2
    for option, value, takes in (
        ("--only", "front-3", "only people, growth, wrap and hair-shell take it"),
        ("--detail", "span", "only people takes it"),
        ("--realism", "all", "only hidden and visible take it"),
    ):
        elsewhere = run(app, ["experiments", "views", option, value])
        assert elsewhere.exit_code == 2
        assert takes in " ".join(elsewhere.stderr.replace("│", " ").split())
    unknown = run(app, ["experiments", "visible", "--realism", "oily,waxy"])
    assert unknown.exit_code == 2
    assert "waxy" in unknown.stderr
    drawn = outlines(tmp_path / "outlines.json", "cam00")
    with pytest.raises(InputError, match="belongs to one folder"):
        judge_folders([folder, folder], model="default", front=None, outlines=drawn, kept=None, report=quiet)
    drawn.write_text("{}")
    with pytest.raises(InputError, match=r"outlines\.json"):
        read_real_capture(folder, tmp_path / "kept", None, drawn, quiet)


@pytest.mark.slow
@pytest.mark.gl
def test_a_folder_without_views_to_hold_out_is_refused_by_name(tmp_path: Path) -> None:
    folder = small_capture(tmp_path / "anna")
    for index in range(3):
        write_image(folder / "masks" / f"cam{index:02}.png", np.pad(np.full((12, 12), 255, np.uint8), 6))
    done = CliRunner().invoke(app, ["experiments", "real", str(folder)])
    assert done.exit_code != 0
    assert "more than 11 are needed" in str(done.exception) + done.stderr
