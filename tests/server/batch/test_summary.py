"""Table and sheet tell of all that is in the folder, whoever made it."""

import csv
from pathlib import Path

import pytest

from server.batch.folder import BatchFolder
from server.batch.summary import write_summary
from tests.support.pinned_batch import pinned_capture, pinned_captures, plan, run_pinned


@pytest.fixture(scope="module")
def done(tmp_path_factory: pytest.TempPathFactory) -> tuple[Path, Path]:
    folder = tmp_path_factory.mktemp("batch")
    shots, out = pinned_captures(folder / "shots", 2), folder / "heads"
    pinned_capture(shots / "bad", 5, "fail")
    run_pinned(shots, out)
    return shots, out


def rows(out: Path) -> dict[str, dict[str, str]]:
    with (out / "heads.csv").open(newline="", encoding="utf-8") as file:
        return {row["capture"]: row for row in csv.DictReader(file)}


def test_done_failed_and_missing(done: tuple[Path, Path]) -> None:
    shots, out = done
    pinned_capture(shots / "late", 6)
    files = write_summary(BatchFolder(out), plan(shots, out))
    assert [file.name for file in files] == ["heads.csv", "heads.parquet", "sheet.html", "sheet.pdf"]
    assert {name: row["state"] for name, row in rows(out).items()} == {
        "bad": "failed", "late": "missing", "s0000": "done", "s0001": "done",
    }  # fmt: skip
    assert rows(out)["bad"]["failure"].count("names no capture") == 2
    assert (out / "sheet.pdf").read_bytes().startswith(b"%PDF-")
    page = (out / "sheet.html").read_text()
    assert page.count("data:image/jpeg") == 2
    assert "4 captures: 2 with warnings, 1 failed, 1 not made yet" in page


def test_results_of_other_settings_are_missing(done: tuple[Path, Path]) -> None:
    shots, out = done
    write_summary(BatchFolder(out), plan(shots, out, {"detail": "photo"}))
    assert {row["state"] for row in rows(out).values()} == {"missing", "failed"}


def test_every_expression_of_the_model_has_its_column(done: tuple[Path, Path]) -> None:
    shots, out = done
    write_summary(BatchFolder(out), plan(shots, out))
    row = rows(out)["s0000"]
    shown = [name for name in row if name.startswith("expression_") and not name.endswith("_std")]
    assert len(shown) == 85
    assert float(row["expression_jawOpen"]) > 0.1
    assert {float(row[name]) for name in shown} == {0.0, float(row["expression_jawOpen"])}
    assert rows(out)["bad"]["expression_jawOpen"] == ""


def test_failures_of_captures_that_are_gone_are_forgotten(done: tuple[Path, Path]) -> None:
    shots, out = done
    folder = BatchFolder(out)
    assert folder.failure("bad") is not None
    write_summary(folder, [task for task in plan(shots, out) if task.capture.name != "bad"])
    assert folder.failure("bad") is None
    assert "bad" not in rows(out)
