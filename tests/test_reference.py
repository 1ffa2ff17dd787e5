"""Pages of reference are what the program says of itself: `make reference` writes them."""

import json
import re
import subprocess
import sys
import tomllib
from pathlib import Path

import pytest
import typer.main

from pipeline.settings import settings_from_document
from server.cli.doctor import OTHER_VARIABLES
from server.cli.main import ROOMS, app
from server.settings import PREFIX, ServiceSettings
from tests.tools.reference import DOCS, OF_EVERY_COMMAND, OF_OTHERS, pages, without_common

ROOT = DOCS.parent
PAGES = pages()


@pytest.mark.parametrize("path", PAGES)
def test_the_committed_page_is_true(path: str) -> None:
    assert (DOCS / path).read_text(encoding="utf-8") == PAGES[path], "make reference"


def test_every_command_has_its_page() -> None:
    listed = [name for _, names in ROOMS.values() for name in names]
    commands = typer.main.get_command(app).commands  # pyright: ignore[reportAttributeAccessIssue]
    assert sorted(listed) == sorted(name for name, command in commands.items() if not command.hidden)
    assert {path.name for path in (DOCS / "commands").iterdir()} == {f"{name}.md" for name in ROOMS}


@pytest.mark.parametrize("page", ["settings.md", "rig-toml.md"])
def test_every_setting_has_its_sentence(page: str) -> None:
    assert re.findall(r"^- `.*\)$", PAGES[page], re.MULTILINE) == []


def test_a_page_says_what_the_command_line_says() -> None:
    """Asked of the command itself, at the same width."""
    command = [str(Path(sys.executable).with_name("eigenhead")), "convert", "--help"]
    done = subprocess.run(command, capture_output=True, text=True, check=True, timeout=60, env={"COLUMNS": "200"})
    (shown,) = re.findall(r"## eigenhead convert\n\n```text\n(.*?)\n```", PAGES["commands/cameras.md"], re.DOTALL)
    assert " ".join(shown.split()) == " ".join(without_common(done.stdout).split())


def test_every_variable_that_is_read_has_its_row_and_its_words() -> None:
    read = {PREFIX + name.upper() for name in ServiceSettings.model_fields} | OTHER_VARIABLES
    assert {PREFIX + name for name in OF_EVERY_COMMAND} == set(OTHER_VARIABLES)
    rows = re.findall(r"^\| `(\w+)` \| (.*?) \| (.*?) \|$", PAGES["environment.md"], re.MULTILINE)
    assert [name for name, _, what in rows if not what] == []
    assert sorted(name for name, _, _ in rows) == sorted(read | {PREFIX + name for name in OF_OTHERS})


@pytest.mark.parametrize("name", OF_OTHERS)
def test_variables_of_others_are_read_somewhere(name: str) -> None:
    if name == "COMPLETE":  # by typer
        return
    folders = [ROOT / "deploy", ROOT / "tests" / "support", ROOT / "tests" / "end_to_end"]
    texts = [
        path.read_text("utf-8")
        for folder in folders
        for path in folder.rglob("*")
        if path.is_file() and path.suffix in ("", ".py")
    ]
    assert any(PREFIX + name in text for text in texts if "OF_OTHERS" not in text)


def test_every_name_of_a_setting_is_read() -> None:
    """By the reader of settings documents, in its table, with its default."""
    table, known = "", 0
    for line in PAGES["settings.md"].splitlines():
        if line.startswith("## "):
            table = line.strip("# `") if "`" in line else ""
        elif found := re.match(r"- `(\w+)` \(`(.*?)`\)", line):
            document: dict = {found[1]: json.loads(found[2])}
            for key in reversed(table.split(".") if table else []):
                document = {key: document}
            settings_from_document(document)
            known += 1
    assert known > 25


def test_every_key_of_the_example_rig_is_described() -> None:
    tables = re.split(r"^## ", PAGES["rig-toml.md"], flags=re.MULTILINE)
    described = {
        part.split("\n")[0].strip("`[]"): set(re.findall(r"^- `(\w+)`", part, re.MULTILINE)) for part in tables
    }
    document = tomllib.loads((ROOT / "deploy" / "rig.example.toml").read_text(encoding="utf-8"))
    for table in ("trigger", "lights", "shot"):
        assert document.pop(table).keys() <= described[table]
    for camera in document.pop("cameras"):
        assert camera.keys() <= described["cameras"]
    assert document.keys() <= described["At the top"]
