"""The documents: links and anchors lead somewhere, formats fit their schemas, what they tell to type works."""

import json
import os
import re
import shutil
import subprocess
import tarfile
from collections.abc import Callable
from pathlib import Path
from typing import Any

import jsonschema_rs
import pytest

from pipeline.applications.templates.header import templates_folder
from pipeline.head_model.model_names import models_folder
from server.cli.doctor import OTHER_VARIABLES
from server.settings import PREFIX, ServiceSettings
from server.storage.store import FOLDERS
from tests.support.report_schema import report_schema
from tests.support.services import ROOT, running_service, small_capture
from tests.tools.reference import OF_OTHERS

DOCS = ROOT / "docs"
NOTES = ROOT / "tests" / "laboratory" / "notes"
PAGES = sorted({*ROOT.glob("*.md"), *DOCS.rglob("*.md"), *NOTES.glob("*.md")})
LINK = re.compile(r"(?<!!)\[[^\]]+\]\(([^)\s]+)\)")
CAN_BE_MADE_AGAIN = {"cache", "incoming", "uploads", "trash", "set-aside"}


def prose(page: Path) -> str:
    return re.sub(r"^```.*?^```", "", page.read_text(encoding="utf-8"), flags=re.MULTILINE | re.DOTALL)


def anchors(page: Path) -> set[str]:
    """As the usual renderers of Markdown make them of headings."""
    headings = re.findall(r"^#+ (.*)$", prose(page), re.MULTILINE)
    return {re.sub(r"[^\w\- ]", "", heading.lower()).replace(" ", "-") for heading in headings}


def test_every_promise_of_security_names_tests_that_are_there() -> None:
    rows = [line for line in (ROOT / "SECURITY.md").read_text(encoding="utf-8").splitlines() if line.startswith("| ")]
    for row in rows[1:]:
        _, promise, tests, _ = row.split("|")
        path = ""
        for file, name in re.findall(r"([\w/.]*)::(\w+)", tests):
            path = file or path
            assert f"\ndef {name}(" in (ROOT / path).read_text(encoding="utf-8"), f"{promise}: {path}::{name}"
        assert path, promise


@pytest.mark.parametrize("page", PAGES, ids=lambda page: page.relative_to(ROOT).as_posix())
def test_every_link_leads_to_a_file_and_a_heading(page: Path) -> None:
    for link in LINK.findall(prose(page)):
        if link.startswith(("http://", "https://")):
            continue
        file, _, anchor = link.partition("#")
        target = (page.parent / file).resolve() if file else page
        assert target.exists(), link
        assert not anchor or anchor in anchors(target), link


@pytest.mark.parametrize("page", PAGES, ids=lambda page: page.relative_to(ROOT).as_posix())
def test_every_path_that_is_named_is_there(page: Path) -> None:
    rooms = r"(?:rig|pipeline|calibration|server|tests|deploy|docs)"
    named = set(re.findall(rf"`({rooms}/[\w./-]+\.\w+)`|\b(docs/[\w/-]+\.md)", prose(page)))
    gone = {path for pair in named for path in pair if path and not (ROOT / path).exists()}
    assert gone <= {"rig/cameras.json", "rig/adjusted.json"}  # of the data folder


def test_every_page_is_reached_from_the_readme() -> None:
    links = {
        page: {(page.parent / link.partition("#")[0]).resolve() for link in LINK.findall(prose(page))} for page in PAGES
    }
    reached, waiting = set(), [ROOT / "README.md"]
    while waiting:
        page = waiting.pop()
        if page in links and page not in reached:
            reached.add(page)
            waiting += links[page]
    assert {path.relative_to(ROOT).as_posix() for path in set(PAGES) - reached} == set()


def test_every_variable_that_is_named_is_read() -> None:
    known = {PREFIX + name.upper() for name in ServiceSettings.model_fields} | OTHER_VARIABLES
    elsewhere = {PREFIX + name for name in OF_OTHERS}
    named = {name for page in PAGES for name in re.findall(r"EIGENHEAD_[A-Z_]*[A-Z]", page.read_text(encoding="utf-8"))}
    assert named - known == elsewhere
    assert len(named & known) > 15


def schema(name: str) -> Any:
    return jsonschema_rs.validator_for(json.loads((DOCS / "schemas" / f"{name}.schema.json").read_text()))


def test_the_examples_of_the_page_of_formats_fit_their_schemas() -> None:
    blocks = re.findall(r"```json\n(.*?)```", (DOCS / "capture-format.md").read_text(encoding="utf-8"), re.DOTALL)
    cameras, features = (json.loads(block) for block in blocks)
    schema("cameras").validate(cameras | {"cameras": cameras["cameras"] * 3})
    schema("features").validate(features)


def test_the_reports_schema_is_that_of_its_type() -> None:
    """`.venv/bin/python -m tests.support.report_schema` writes it anew."""
    kept = json.loads((DOCS / "schemas" / "report.schema.json").read_text())
    assert kept == report_schema()


def block(name: str, page: str = "service.md") -> str:
    text = (DOCS / page).read_text(encoding="utf-8")
    (code,) = re.findall(rf"<!-- code: {name} -->\n```sh\n(.*?)```", text, re.DOTALL)
    return code


def test_the_backup_names_every_folder_that_cannot_be_made_again() -> None:
    (named,) = re.findall(r"for folder in (.*);", block("backup"))
    assert set(FOLDERS) - CAN_BE_MADE_AGAIN <= set(named.split())
    kept_elsewhere = {models_folder().name, templates_folder().name, "console"}
    assert kept_elsewhere <= set(named.split())


@pytest.fixture
def shell(tmp_path: Path) -> Callable[..., str]:
    if shutil.which("curl") is None:
        pytest.skip("curl is not installed (apt-get install curl)")

    def run(code: str, **variables: str) -> str:
        environment = os.environ | variables | {"no_proxy": "127.0.0.1"}
        command = ["bash", "-euo", "pipefail", "-c", code]
        done = subprocess.run(
            command, cwd=tmp_path, env=environment, capture_output=True, text=True, timeout=120, check=False
        )
        assert done.returncode == 0, done.stderr
        return done.stdout

    return run


@pytest.mark.slow
def test_the_walk_with_curl_and_a_backup_elsewhere(shell: Callable[..., str], tmp_path: Path) -> None:
    with tarfile.open(tmp_path / "anna.tar", "w") as archive:
        archive.add(small_capture(tmp_path / "capture"), ".")
    data, copy = tmp_path / "data", tmp_path / "copy"
    key = shell(f"cd {ROOT} && .venv/bin/eigenhead keys add lab --data {data}").strip()
    with running_service(data) as service:
        shell("until curl -fsS $URL/readyz; do sleep 0.5; done", URL=service.url)
        printed = shell(block("walk-through", "http.md"), URL=service.url, KEY=key)
        assert "event: end" in printed
        shell(block("backup"), DATA=str(data), BACKUP=str(copy))
    with running_service(copy) as restored:
        (job,) = (folder.name for folder in (copy / "jobs").iterdir())
        fetch = f'curl -fsS -H "Authorization: Bearer $KEY" -o again.ply "$URL/v1/jobs/{job}/result/head.ply"'
        shell(fetch, URL=restored.url, KEY=key)
    assert (tmp_path / "again.ply").read_bytes() == (tmp_path / "anna" / "head.ply").read_bytes()
