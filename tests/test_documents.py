"""What a reader meets: pages that end, cells that are read at once, one place for each thing, a way in for each reader.

Links are held by ``test_docs.py``, pages that are made of the program by ``test_reference.py``.
"""

import re
from pathlib import Path

import pytest
import yaml

from tests.test_docs import DOCS, PAGES, ROOT, prose

MAX_LINES, MAX_CELL_WORDS = 250, 30
KINDS = ["Tutorials", "How to", "Reference", "Explanation", "Results"]
READERS = ("Operator", "Administrator", "Integrator", "Developer")
FORMAT = re.compile(r"\beigenhead-[a-z-]+/\d+\b")


def words(cell: str) -> int:
    """Counts words; code is names, and where a link leads is not read."""
    shown = re.sub(r"\]\([^)]*\)", "]", re.sub(r"`[^`]*`", "", cell))
    return sum(bool(re.search(r"\w", word)) for word in shown.split())


def cells(line: str) -> list[str]:
    return re.split(r"(?<!\\)\|", line.strip().strip("|"))


def too_long(text: str) -> list[str]:
    lines = [line for line in text.splitlines() if line.lstrip().startswith("|")]
    return [cell.strip()[:60] for line in lines for cell in cells(line) if words(cell) > MAX_CELL_WORDS]


def length(page: Path) -> int:
    """Of the changes, which grow with every version, the longest version counts."""
    text = page.read_text(encoding="utf-8")
    parts = text.split("\n## ") if page.name == "CHANGELOG.md" else [text]
    return max(part.count("\n") for part in parts)


@pytest.mark.parametrize("page", PAGES, ids=lambda page: page.relative_to(ROOT).as_posix())
def test_a_page_ends_and_its_cells_are_short(page: Path) -> None:
    assert length(page) <= MAX_LINES
    assert too_long(prose(page)) == []


def test_long_cells_are_found() -> None:
    long = "word " * (MAX_CELL_WORDS + 1)
    assert too_long(f"| a | {long}|\n| b | {long[5:]}|\n") == [long.strip()[:60]]
    assert words("`code is names` [two words](a-b.md#c) and more") == 4


def navigation(entries: list, kind: str = "") -> dict[str, str]:
    """Pages of the site by the part of the navigation that they stand in."""
    found = {}
    for entry in entries:
        for title, inner in entry.items() if isinstance(entry, dict) else [("", entry)]:
            if isinstance(inner, list):
                found |= navigation(inner, kind or title)
            else:
                found[inner] = kind
    return found


def test_the_navigation_goes_by_what_a_reader_wants() -> None:
    nav = yaml.safe_load((ROOT / "mkdocs.yml").read_text(encoding="utf-8"))["nav"]
    assert [title for entry in nav for title in entry] == ["eigenhead", *KINDS]
    pages = navigation(nav)
    front = (ROOT / "README.md").read_text(encoding="utf-8")
    assert all(f"\n**{reader}**: you" in front or f"\n**{reader}**: your" in front for reader in READERS)
    here = {path.relative_to(DOCS).as_posix() for path in PAGES if DOCS in path.parents}
    assert here <= set(pages), "mkdocs names the others at the top of the checkout"


def test_every_format_has_its_place() -> None:
    rooms = [ROOT / room for room in ("rig", "pipeline", "calibration", "server")]
    written = {
        name
        for room in rooms
        for path in room.rglob("*.py")
        for name in FORMAT.findall(path.read_text(encoding="utf-8"))
    }
    assert len(written) > 15
    assert written - set(FORMAT.findall((DOCS / "formats.md").read_text(encoding="utf-8"))) == set()


@pytest.mark.parametrize("name", ["board.toml", "rig.toml"])
def test_a_file_is_described_on_one_page(name: str) -> None:
    headings = re.compile(rf"^#+ {re.escape(name)}$", re.MULTILINE)
    assert len([page for page in PAGES if headings.search(page.read_text(encoding="utf-8"))]) == 1


def test_a_term_of_the_glossary_is_one_sentence() -> None:
    text = (DOCS / "glossary.md").read_text(encoding="utf-8")
    entries = re.findall(r"^- \*\*(.+?)\*\*: (.+(?:\n  .+)*)$", text, re.MULTILINE)
    assert len(entries) > 50
    names = [name for name, _ in entries]
    assert len(names) == len(set(names))
    for name, sentence in entries:
        plain = re.sub(r"\([^()]*(?:\([^()]*\)[^()]*)*\)", "", sentence).strip()
        assert not re.search(r"[a-z]{2}\. [A-Z]", plain), name


def test_the_buyers_pages_hold_no_trials() -> None:
    for name in ("results.md", "results-operation.md"):
        assert not re.search(r"\b[Tt]ried\b|without (?:a )?gain|not taken", prose(DOCS / name)), name
