"""The command line of the laboratory: names, options made from signatures, wrong usage; and the folders of ``real``."""

import json
from collections.abc import Sequence
from pathlib import Path
from typing import Annotated, Any, Literal

import numpy as np
import pytest

from rig.errors import InputError
from rig.formats.cameras.cameras_json import read_rig
from rig.formats.pictures.images import write_image
from rig.progress import discard_progress
from tests.laboratory.__main__ import describe, main
from tests.laboratory.experiments.faults.real import read_real_capture, real
from tests.laboratory.runner import Record, call, lines_of, parser_of
from tests.laboratory.table import BENCHMARKS, EXPERIMENTS
from tests.support.services import small_capture

# The names of the contract.
NAMES = [
    "table1", "table2", "table3", "cost", "levels", "peers", "limit", "robustness", "convergence", "alignment",
    "drift", "exchanges", "posterior", "views", "repeat", "relief", "pores", "span", "detail",
    "hidden", "capped", "expressions", "visible", "people", "planted", "surfaces", "texture", "light", "templates",
    "shapes", "eyeballs", "gazes", "inner-mouth", "meshes", "wrap", "scaling", "growth", "scale",
    "real"
]  # fmt: skip


def outlines(path: Path, *names: str) -> Path:
    square = [[[4, 4], [12, 4], [12, 12], [4, 12]]]
    document = {"format": "eigenhead-outlines/1", "outlines": dict.fromkeys(names, square)}
    path.write_text(json.dumps(document))
    return path


def status_of(*words: str) -> int | str | None:
    with pytest.raises(SystemExit) as ended:
        main([*words])
    return ended.value.code


def measure(
    what: Literal["one", "two"],
    folders: Sequence[Path] = (),
    *,
    height: int,
    error_px: float = 0.5,
    bare: Annotated[bool, "without plates"] = False,
    only: Sequence[str] = (),
    table: dict[str, int] | None = None,
) -> dict[str, Any]:
    return {"figures": {"height": height, "of": {"only": [*only]}}, "what": what, "bare": bare, "folders": [*folders]}


def heights(*, top_mm: int = 3) -> int:
    return 2 * top_mm


def test_every_name_of_the_contract_is_there() -> None:
    assert not set(NAMES) - set(EXPERIMENTS)  # guards came later
    assert all(f"  {name} " in describe() for name in EXPERIMENTS | BENCHMARKS)


@pytest.mark.parametrize("name", EXPERIMENTS | BENCHMARKS)
def test_every_record_has_a_function_whose_inputs_can_be_made(name: str) -> None:
    record = (EXPERIMENTS | BENCHMARKS)[name]
    options = parser_of(name, record, record.load()).format_help()
    assert "--json" in options
    assert record.sentence.endswith(".")
    if name in EXPERIMENTS:
        assert all(f"--{option} " in options for option in ("model", "subjects", "shared", "out"))


def test_options_come_from_the_signature() -> None:
    record = Record("tests:measure", "Measures.", {"height": heights})
    parser = parser_of("measure", record, measure)
    values = vars(parser.parse_args(["two", "a", "b", "--only", "x", "--only", "y", "--bare", "--top-mm", "5"]))
    assert values.pop("json") is False
    assert values["folders"] == [Path("a"), Path("b")]
    assert "table" not in values
    assert "height" not in values
    found = call(measure, record.takes, **{key: value for key, value in values.items() if value is not None})
    assert found["figures"] == {"height": 10, "of": {"only": ["x", "y"]}}
    assert (found["what"], found["bare"]) == ("two", True)
    assert lines_of(found) == [f"{'height':<40} 10", f"{'of only':<40} " + json.dumps(["x", "y"])]
    for wrong in (["three"], ["one", "--top-mm", "-1"], ["one", "--tall"], []):
        with pytest.raises(SystemExit):
            parser.parse_args(wrong)


def test_wrong_usage_ends_with_status_2(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    folder = small_capture(tmp_path / "anna")
    for words, said in (
        (["table9"], "no experiment or benchmark is called 'table9'"),
        (["real", str(folder), str(tmp_path / "nobody")], "nobody: no such folder"),
        (["real"], "name the folders of the photographs"),
        (["views", str(folder)], "unrecognized arguments"),
        (["views", "--only", "front-3"], "unrecognized arguments"),
        (["views", "--detail", "span"], "unrecognized arguments"),
        (["views", "--realism", "all"], "unrecognized arguments"),
        (["views", "--subjects", "0"], "0 is less than 1"),
        (["visible", "--realism", "oily,waxy"], "waxy"),
    ):
        assert status_of(*words) == 2
        assert said in " ".join(capsys.readouterr().err.split())


def test_it_prints_an_example_or_one_json_object_that_holds_the_figures(capsys: pytest.CaptureFixture[str]) -> None:
    main([])
    assert "Example: python -m tests.laboratory limit --subjects 3 --json" in capsys.readouterr().out
    main(["scale", "--json"])
    assert json.loads(capsys.readouterr().out)["figures"]["usd_1000_computing"] > 0.0


def test_outlines_and_masks_of_a_folder_judge_it_and_wrong_ones_are_refused(tmp_path: Path) -> None:
    folder = small_capture(tmp_path / "anna")
    write_image(folder / "masks" / "cam00.png", np.pad(np.full((12, 12), 255, np.uint8), 6))
    outlines(folder / "outlines.json", "cam01", "cam07")
    capture = read_real_capture(folder, tmp_path / "kept", "cam02", None, discard_progress)
    names = read_rig(folder / "cameras.json").names
    assert (capture.name, capture.front, capture.rig.names) == ("anna", "cam02", names)
    assert set(capture.drawn) == {"cam00", "cam01"}
    assert capture.drawn["cam00"].sum() == 144
    assert capture.drawn["cam01"].sum() == pytest.approx(81, abs=2)
    drawn = outlines(tmp_path / "other.json", "cam02")
    other = read_real_capture(folder, tmp_path / "kept", None, drawn, discard_progress)
    assert set(other.drawn) == {"cam00", "cam02"}
    assert not (tmp_path / "kept").exists(), "the cameras were given"
    with pytest.raises(InputError, match="belongs to one folder"):
        call(real, {"folders": lambda: [folder, folder]}, outlines=drawn)
    drawn.write_text("{}")
    with pytest.raises(InputError, match=r"outlines\.json: has no outlines"):
        read_real_capture(folder, tmp_path / "kept", None, drawn, discard_progress)


@pytest.mark.slow
@pytest.mark.gl
def test_a_folder_without_views_to_hold_out_is_refused_by_name(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    folder = small_capture(tmp_path / "anna")
    for index in range(3):
        write_image(folder / "masks" / f"cam{index:02}.png", np.pad(np.full((12, 12), 255, np.uint8), 6))
    assert status_of("real", str(folder)) == 1
    assert "more than 11 are needed" in capsys.readouterr().err
