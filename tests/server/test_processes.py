"""Processes of the service run this checkout's code, wherever they start."""

import subprocess
import sys
from pathlib import Path

import pytest

from server.processes import python_command, python_environment
from server.tasks.child import Child
from server.tasks.egl import try_egl
from tests.support.hostile_folder import hostile_folder


@pytest.fixture
def marker(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Path:
    """Working directory and PYTHONPATH hold packages with the project's names."""
    marker = hostile_folder(tmp_path / "hostile")
    monkeypatch.chdir(tmp_path / "hostile")
    monkeypatch.setenv("PYTHONPATH", str(tmp_path / "hostile"))
    return marker


def test_a_child_imports_nothing_from_the_working_directory_or_pythonpath(marker: Path) -> None:
    child = Child()
    try:
        child.remote(try_egl)()
    finally:
        child.close()
    assert not marker.exists()


def test_a_worker_starts_beside_foreign_packages(marker: Path) -> None:
    command = python_command("cli", "worker", "--help")
    done = subprocess.run(command, env=python_environment(), capture_output=True, text=True, timeout=60, check=False)
    assert done.returncode == 0, done.stderr
    assert not marker.exists()


def test_the_command_of_the_checkout_runs_beside_foreign_packages(marker: Path) -> None:
    command = Path(sys.executable).with_name("eigenhead")
    done = subprocess.run([command, "--help"], capture_output=True, text=True, timeout=60, check=False)
    assert done.returncode == 0, done.stderr
    assert not marker.exists()
