"""The pure parts of the console's scripts, tested in their own language: ``static/*.test.js``, by playwright's Node."""

import os
import re
import shutil
import subprocess
import sys
from pathlib import Path

import nicegui
import pytest

from tests.support.console_words import CONSOLE
from tests.support.node import node

ROOT = Path(__file__).resolve().parents[3]
TESTS = sorted((Path(__file__).parent / "static").glob("*.test.js"))
SCENE = Path(nicegui.__file__).parent / "elements" / "scene" / "dist" / "index.js"


@pytest.mark.parametrize("script", TESTS, ids=lambda path: path.name.partition(".")[0])
def test_pure_parts(script: Path) -> None:
    preload = (ROOT / "tests" / "support" / "console_modules.js").as_uri()
    environment = os.environ | {"CONSOLE_STATIC": str(CONSOLE / "static"), "SCENE_MODULE": str(SCENE), "TZ": "UTC"}
    command = [node(), "--no-warnings", "--import", preload, "--test", str(script)]
    done = subprocess.run(command, env=environment, capture_output=True, text=True, timeout=60, check=False)
    assert done.returncode == 0, done.stdout
    assert int(re.findall(r"pass (\d+)", done.stdout)[-1]) >= 2


def test_every_test_has_its_script() -> None:
    assert [path.name for path in TESTS if not (CONSOLE / "static" / path.name.replace(".test", "")).is_file()] == []


def test_a_line_is_short_unless_a_sentence_in_it_is_long() -> None:
    """Biome breaks no templates, and no diff shows what changed in a line of 600 characters."""
    scripts = [path for path in CONSOLE.rglob("*.js") if not path.name.endswith("de.js")]  # a sentence a line
    long = [line for path in scripts for line in path.read_text().splitlines() if len(line) > 120]
    assert [line for line in long if max(map(len, re.split(r"['\"<>`]|\{\{|}}|//", line))) < 50] == []


def test_biome_finds_nothing_and_finds_what_is_planted(tmp_path: Path) -> None:
    """As `make check` asks; `deploy/setup.sh --docs` installs it."""
    biome = Path(sys.executable).with_name("biome")
    if not biome.is_file():
        pytest.skip("biome is not installed (deploy/setup.sh --docs)")
    for folder in ("server/console", "tests/server/console/static"):
        shutil.copytree(ROOT / folder, tmp_path / folder, ignore=shutil.ignore_patterns("__pycache__", "*.py"))
    shutil.copy(ROOT / "biome.json", tmp_path)

    def check() -> subprocess.CompletedProcess[str]:
        return subprocess.run([biome, "ci"], cwd=tmp_path, capture_output=True, text=True, timeout=60, check=False)

    assert check().returncode == 0, check().stderr
    with (tmp_path / "server" / "console" / "static" / "words.js").open("a") as script:
        script.write("const nobody = 1;\n")
    done = check()
    assert done.returncode != 0
    assert "noUnusedVariables" in done.stdout + done.stderr
