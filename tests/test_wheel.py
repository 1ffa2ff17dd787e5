"""The wheel carries the packages under a name of its own, and runs beside any folder."""

import importlib.metadata
import json
import os
import re
import shutil
import subprocess
import sys
import tomllib
import venv
from collections.abc import Iterator
from pathlib import Path
from types import ModuleType

import numpy as np
import pytest

from tests.support.hostile_folder import hostile_folder
from tests.support.scripts import import_script
from tests.support.uv import uv

ROOT = Path(__file__).resolve().parents[1]


@pytest.fixture(scope="module")
def wheel_imports() -> ModuleType:
    return import_script(ROOT / "deploy" / "wheel_imports.py")


@pytest.mark.parametrize(
    ("line", "moved"),
    [
        ("from rig.camera import Camera", "from eigenhead.rig.camera import Camera"),
        ("    from pipeline import settings", "    from eigenhead.pipeline import settings"),
        ("from   server.settings import (", "from   eigenhead.server.settings import ("),
        ("s = 'ü'; from rig import mesh", "s = 'ü'; from eigenhead.rig import mesh"),
        ("from rigid import body", "from rigid import body"),
        ("from . import rig", "from . import rig"),
        ("import numpy", "import numpy"),
        ("text = 'from rig.camera import Camera'", "text = 'from rig.camera import Camera'"),
    ],
)
def test_an_import_moves_and_other_text_stays(wheel_imports: ModuleType, line: str, moved: str) -> None:
    before, after = ("def f():\n" if line[0] == " " else ""), ("\n    a)\n" if line.endswith("(") else "\n")
    found = wheel_imports.moved_imports((before + line + after).encode(), Path("rig/a.py"), ROOT)
    assert found.decode() == before + moved + after


@pytest.mark.parametrize(
    "line",
    [
        "import rig.camera",
        "import numpy, pipeline as p",
        "name = 'server.worker.worker'",
        "name = 'server.worker.worker:run_worker'",
        "name = f'rig.drivers.{driver}'",
    ],
)
def test_what_cannot_move_ends_the_build_with_its_line(wheel_imports: ModuleType, line: str) -> None:
    with pytest.raises(wheel_imports.ImportCannotMove, match=r"rig/a\.py:2: "):
        wheel_imports.moved_imports(f"# a module\n{line}\n".encode(), Path("rig/a.py"), ROOT)


def test_every_module_can_be_carried(wheel_imports: ModuleType, tmp_path: Path) -> None:
    wheel_imports.carry_packages(ROOT, tmp_path)
    for path in tmp_path.rglob("*.py"):
        compile(path.read_bytes(), str(path), "exec")
    assert {path.name for path in tmp_path.iterdir()} == set(wheel_imports.PACKAGES)


def test_the_checkout_has_the_public_names_too() -> None:
    import eigenhead

    from pipeline.reconstruct import reconstruct

    assert eigenhead.reconstruct is reconstruct
    for name in eigenhead.__all__:
        assert getattr(eigenhead, name).__name__ == name
    with pytest.raises(AttributeError, match="no attribute 'colour'"):
        _ = eigenhead.colour


def installed_wheel(folder: Path, environment: dict[str, str]) -> Iterator[Path]:
    """The folder of programs of an environment that holds the wheel, and the packages it depends on from ours. The
    wheel is built from the source archive, as those do who get that alone."""
    build = [uv(), "build", "--no-build-isolation", "--offline", "--python", sys.executable, "-o", folder]
    subprocess.run([*build, ROOT], env=os.environ | environment, check=True, capture_output=True, timeout=600)
    assert len([*folder.glob("eigenhead-*.tar.gz")]) == 1
    venv.create(folder / "venv", symlinks=True)
    python = folder / "venv" / "bin" / "python"
    install = [uv(), "pip", "install", "--offline", "--no-deps", "--python", python, *folder.glob("*.whl")]
    subprocess.run(install, check=True, capture_output=True, timeout=120)
    (site,) = (folder / "venv").glob("lib/python3*/site-packages")
    (site / "dependencies.pth").write_text(f"{Path(np.__file__).parents[1]}\n")  # without our .pth files: no checkout
    yield python.parent
    shutil.rmtree(folder)


@pytest.fixture(scope="module")
def installed(tmp_path_factory: pytest.TempPathFactory) -> Iterator[Path]:
    yield from installed_wheel(tmp_path_factory.mktemp("wheel"), {})


@pytest.fixture(scope="module")
def installed_with_loops(tmp_path_factory: pytest.TempPathFactory) -> Iterator[Path]:
    yield from installed_wheel(tmp_path_factory.mktemp("wheel"), {"EIGENHEAD_WHEEL_LOOPS": "1"})


def test_a_tagged_commit_has_the_version_of_its_tag() -> None:
    """The version stands in pyproject.toml: a clone without tags, an archive and an installed wheel know it alike."""
    project = tomllib.loads((ROOT / "pyproject.toml").read_text(encoding="utf-8"))["project"]["version"]
    assert importlib.metadata.version("eigenhead") == project
    headings = re.findall(
        r"^## \[(.+?)\](?: - \d{4}-\d\d-\d\d)?$", (ROOT / "CHANGELOG.md").read_text("utf-8"), re.MULTILINE
    )
    assert headings[:2] == ["Unreleased", project]
    command = ["git", "tag", "--points-at", "HEAD", "--list", "v*"]
    tags = subprocess.run(command, cwd=ROOT, capture_output=True, text=True, timeout=60, check=False).stdout.split()
    assert tags in ([], [f"v{project}"])


def run(folder: Path, *command: str | Path) -> str:
    environment = os.environ | {"PYTHONPATH": str(folder), "EIGENHEAD_DATA": str(folder / "data")}
    done = subprocess.run(
        command, cwd=folder, env=environment, capture_output=True, text=True, timeout=600, check=False
    )
    assert done.returncode == 0, done.stderr
    return done.stdout


@pytest.mark.slow
@pytest.mark.timeout(900)
def test_the_wheel_runs_none_of_the_code_of_a_folder_with_its_packages_names(installed: Path, tmp_path: Path) -> None:
    marker = hostile_folder(tmp_path)
    assert "reconstruct" in run(tmp_path, installed / "eigenhead", "--help")
    run(tmp_path, installed / "eigenhead", "simulate", "shot", "--seed", "3")
    assert (tmp_path / "shot" / "cameras.json").is_file()
    assert not marker.exists(), marker.read_text()


@pytest.mark.nightly
@pytest.mark.timeout(900)
def test_the_demo_runs_none_of_it_either(installed_with_loops: Path, tmp_path: Path) -> None:
    """It starts the service, its worker and their children from that folder."""
    marker = hostile_folder(tmp_path)
    answer = json.loads(run(tmp_path, installed_with_loops / "eigenhead", "demo", "--out", "out", "--json"))
    assert Path(tmp_path, answer["ply"]).is_file()
    assert not marker.exists(), marker.read_text()


@pytest.mark.nightly
def test_a_wheel_carries_its_loops(installed_with_loops: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setenv("EIGENHEAD_CACHE", str(tmp_path / "cache"))
    answer = json.loads(run(tmp_path, installed_with_loops / "eigenhead", "prepare", "--json"))
    assert answer["compiled"] == 0
    assert answer["known"] > 30
    assert not list(tmp_path.glob("cache/kernels/*"))


@pytest.mark.slow
def test_the_wheels_python_names_and_module_start(installed: Path, tmp_path: Path) -> None:
    marker = hostile_folder(tmp_path)
    code = "import eigenhead; print(eigenhead.reconstruct.__module__)"
    assert run(tmp_path, installed / "python", "-c", code) == "eigenhead.pipeline.reconstruct\n"
    assert "Usage" in run(tmp_path, installed / "python", "-m", "eigenhead", "--help")
    assert not marker.exists()


@pytest.mark.slow
@pytest.mark.gl
@pytest.mark.timeout(900)
def test_the_ten_lines_of_the_documentation_run(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.chdir(tmp_path)
    run(tmp_path, Path(sys.executable).with_name("eigenhead"), "simulate", "shots/anna")
    (code,) = re.findall(r"```python\n(.*?)```", (ROOT / "docs" / "python.md").read_text(encoding="utf-8"), re.DOTALL)
    (tmp_path / "ten_lines.py").write_text(code)
    vertices = run(tmp_path, sys.executable, "ten_lines.py")
    assert vertices.startswith("(")
    assert (tmp_path / "heads" / "anna" / "head.ply").is_file()
