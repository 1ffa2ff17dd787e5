"""Tables of figures: documents show what is kept, and a command's figures are kept as it printed them."""

import datetime
import json
import re
from pathlib import Path

import pytest

from tests.tools import results
from tests.tools.results import DOCUMENTS, TABLE, UnknownTable, kept, main, names, take, with_tables


@pytest.mark.parametrize("document", DOCUMENTS, ids=lambda path: path.stem)
def test_documents_show_the_figures_that_are_kept(document: Path) -> None:
    """`make results` writes them."""
    text = document.read_text(encoding="utf-8")
    assert text.count("<!-- table:") == len(TABLE.findall(text)), "each has its end"
    assert with_tables(text) == text


def test_every_table_is_shown_somewhere() -> None:
    text = "".join(path.read_text(encoding="utf-8") for path in DOCUMENTS)
    assert {found[1] for found in TABLE.findall(text)} == {path.stem for path in results.KEPT.glob("*.txt")}


@pytest.mark.parametrize("name", names())
def test_what_is_kept_says_how_when_and_on_what(name: str) -> None:
    document = kept(name)
    assert set(document) == {"command", "date", "machine", "figures"}
    assert re.match(r"python -m tests\.laboratory \w+ ", document["command"])
    assert datetime.date.fromisoformat(document["date"]) >= datetime.date(2026, 1, 1)
    assert re.fullmatch(r"\d+ cores of \w+", document["machine"])  # neither a host's name nor a path
    assert document["figures"]
    assert all(isinstance(value, int | float) for value in document["figures"].values())


def test_the_figure_of_uncertainty_shows_what_the_experiment_found() -> None:
    """And the page says in how many rows sigma is too small."""
    figure = results.uncertainty_svg(kept("hidden")["figures"])
    assert results.UNCERTAINTY.read_text(encoding="utf-8") == figure
    drawn = [(float(one), float(other)) for one, other in re.findall(r">([\d.]+) / ([\d.]+) mm<", figure)]
    too_small = sum(measured > predicted for predicted, measured in drawn)
    page = (results.ROOT / "docs" / "uncertainty.md").read_text(encoding="utf-8")
    assert f"too small in {too_small} of {len(drawn)} rows" in page


@pytest.fixture
def folder(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Path:
    """Kept figures of one table, and a document that shows it twice."""
    program = tmp_path / "measure.py"
    program.write_text('print(\'{"figures": {"a-b_0.3px": 0.1234, "share": 0.7}, "rows": [1, 2]}\')')
    (tmp_path / "errors.json").write_text(json.dumps({"command": f"python {program}"}))
    (tmp_path / "errors.txt").write_text("| {a-b_0.3px:.2f} mm | {share:.0%} |\n")
    (tmp_path / "errors.readme.txt").write_text("{share:.1f}, {date:}\n")
    shown = "<!-- table: {} -->\n\n| old |\n\n<!-- end of table -->\n"
    (tmp_path / "document.md").write_text(
        f"Before {{brace:d}}.\n\n{shown.format('errors')}\nText.\n\n{shown.format('errors.readme')}"
    )
    monkeypatch.setattr(results, "KEPT", tmp_path)
    monkeypatch.setattr(results, "DOCUMENTS", (tmp_path / "document.md",))
    monkeypatch.setattr(results, "write_uncertainty", lambda: None)
    return tmp_path


def test_a_command_is_run_its_figures_kept_and_every_document_written(folder: Path) -> None:
    main(["errors"])
    document = kept("errors")
    assert document["figures"] == {"a-b_0.3px": 0.1234, "share": 0.7}
    today = datetime.datetime.now(datetime.UTC).date().isoformat()
    assert document["date"] == today
    assert (folder / "document.md").read_text() == (
        "Before {brace:d}.\n\n<!-- table: errors -->\n\n| 0.12 mm | 70% |\n\n<!-- end of table -->\n\nText.\n\n"
        f"<!-- table: errors.readme -->\n\n0.7, {today}\n\n<!-- end of table -->\n"
    )
    written = (folder / "document.md").read_text()
    main([])
    assert (folder / "document.md").read_text() == written


def test_a_figure_that_is_not_kept_is_named(folder: Path) -> None:
    take("errors")
    (folder / "errors.txt").write_text("{another:.2f}")
    before = (folder / "document.md").read_text()
    with pytest.raises(KeyError, match="another"):
        main([])
    assert (folder / "document.md").read_text() == before


def test_an_unknown_table_is_refused_with_those_that_there_are(folder: Path) -> None:
    with pytest.raises(UnknownTable, match=r"'colours'; there are errors"):
        main(["colours"])
