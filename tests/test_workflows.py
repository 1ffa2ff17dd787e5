"""The workflows of .github call make's targets and nothing else, so that what a machine runs is what anybody types."""

import re
from pathlib import Path
from typing import Any

import pytest
import yaml

ROOT = Path(__file__).resolve().parents[1]
WORKFLOWS = sorted((ROOT / ".github" / "workflows").glob("*.yml"))
TRIGGERS = {
    "check": {"push", "pull_request"},
    "fast": {"push", "pull_request"},
    "slow": {"schedule", "workflow_dispatch"},
}
TARGETS = {"check": ["check"], "fast": ["setup-tests", "test", "test-shapes"], "slow": ["setup-tests", "test-nightly"]}
PREREQUISITES = "apt-get update && apt-get install -y --no-install-recommends git make python3 ca-certificates"


def read(path: Path) -> dict[str, Any]:
    """Returns the document; YAML 1.1 reads the key ``on`` as true."""
    document = yaml.safe_load(path.read_text(encoding="utf-8"))
    return document | {"on": document.pop(True)}


def test_there_is_one_for_checks_one_for_fast_tests_and_one_for_the_night() -> None:
    assert {path.stem: set(read(path)["on"]) for path in WORKFLOWS} == TRIGGERS


@pytest.mark.parametrize("path", WORKFLOWS, ids=lambda path: path.stem)
def test_a_workflow_runs_make_and_nothing_else(path: Path) -> None:
    (job,) = read(path)["jobs"].values()
    commands = [step["run"] for step in job["steps"] if "run" in step]
    assert commands[0] == PREREQUISITES
    assert commands[1:] == [f"make {target}" for target in TARGETS[path.stem]]
    assert {step["uses"].partition("@")[0] for step in job["steps"] if "uses" in step} == {"actions/checkout"}
    assert read(path)["permissions"] == {"contents": "read"}
    assert job["timeout-minutes"] <= 180


def test_every_target_that_a_workflow_calls_is_one_of_make() -> None:
    known = set(re.findall(r"^([a-z-]+):", (ROOT / "Makefile").read_text(encoding="utf-8"), re.MULTILINE))
    assert {target for targets in TARGETS.values() for target in targets} <= known


def test_code_owners_name_paths_that_are_there() -> None:
    text = (ROOT / ".github" / "CODEOWNERS").read_text(encoding="utf-8")
    paths = re.findall(r"^#? ?/([\w/]+)/\s+@", text, re.MULTILINE)
    assert len(paths) > 5
    assert [path for path in paths if not (ROOT / path).is_dir()] == []
