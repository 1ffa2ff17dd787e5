"""The house rules hold, and the linter that checks them fires."""

import ast
import os
import shutil
import subprocess
import sys
from pathlib import Path

import pytest

ROOT = Path(__file__).resolve().parents[1]
ROOMS = ("rig", "pipeline", "calibration", "server")


def lint_imports(folder: Path) -> subprocess.CompletedProcess[str]:
    program = Path(sys.executable).with_name("lint-imports")
    environment = os.environ | {"PYTHONPATH": str(folder)}
    command = [str(program), "--no-cache"]
    return subprocess.run(
        command, cwd=folder, env=environment, capture_output=True, text=True, timeout=120, check=False
    )


@pytest.fixture
def copy(tmp_path: Path) -> Path:
    for room in ROOMS:
        shutil.copytree(ROOT / room, tmp_path / room, ignore=shutil.ignore_patterns("__pycache__", "*.npz"))
    shutil.copy(ROOT / "pyproject.toml", tmp_path)
    return tmp_path


@pytest.mark.parametrize(
    ("module", "line", "contract"),
    [
        ("rig/mesh.py", "import pipeline.settings", "Data flows"),
        ("pipeline/settings.py", "import calibration", "Data flows"),
        ("pipeline/settings.py", "import pydantic", "web framework"),
        ("pipeline/settings.py", "import moderngl", "OpenGL"),
    ],
)
def test_import_linter_fires_on_a_planted_violation(copy: Path, module: str, line: str, contract: str) -> None:
    assert lint_imports(copy).returncode == 0
    with (copy / module).open("a") as file:
        file.write(f"\n{line}\n")
    outcome = lint_imports(copy)
    assert outcome.returncode == 1
    broken = [text for text in outcome.stdout.splitlines() if text.endswith("BROKEN")]
    assert len(broken) == 1
    assert contract in broken[0]


def test_init_files_hold_a_docstring_and_nothing_else() -> None:
    for path in (path for room in ROOMS for path in (ROOT / room).rglob("__init__.py")):
        statements = ast.parse(path.read_text(encoding="utf-8")).body
        assert all(isinstance(statement, ast.Expr) for statement in statements), (
            f"{path}: each name has one import path"
        )


def test_no_room_is_called_utils() -> None:
    banned = {"utils", "util", "helpers", "common", "manager", "processor"}
    names = {path.stem for room in ROOMS for path in (ROOT / room).rglob("*")}
    assert not names & banned
