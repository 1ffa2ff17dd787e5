"""deploy/setup.sh and what it stands on: the download of uv, the quick way out, the list of allowed skips."""

import hashlib
import io
import os
import shutil
import subprocess
import sys
import zipfile
from collections.abc import Iterator
from http.server import SimpleHTTPRequestHandler
from pathlib import Path
from types import ModuleType

import pytest

from tests.support.loopback import served
from tests.support.scripts import import_script

ROOT = Path(__file__).resolve().parents[1]
PROGRAM = b"#!/bin/sh\necho uv 9.9.9\n"


@pytest.fixture
def fetch_uv() -> ModuleType:
    return import_script(ROOT / "deploy" / "fetch_uv.py")


@pytest.fixture
def index(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Iterator[Path]:
    """A package index on this machine with one wheel; relative links, as mirrors have them."""
    wheel = io.BytesIO()
    with zipfile.ZipFile(wheel, "w") as archive:
        archive.writestr("uv-1.0.data/scripts/uvx", b"another program")
        archive.writestr("uv-1.0.data/scripts/uv", PROGRAM)
    site = tmp_path / "site"
    (site / "simple" / "uv").mkdir(parents=True)
    (site / "files").mkdir()
    (site / "files" / "uv-1.0-x.whl").write_bytes(wheel.getvalue())
    page = '<a href="../../files/uv-0.9-x.whl">old</a><a href="../../files/uv-1.0-x.whl#sha256=whatever">new</a>'
    (site / "simple" / "uv" / "index.html").write_text(page)
    monkeypatch.setenv("no_proxy", "127.0.0.1")
    with served(SimpleHTTPRequestHandler, site) as url:
        monkeypatch.setenv("UV_DEFAULT_INDEX", f"{url}/simple")
        yield site


def pin(fetch_uv: ModuleType, monkeypatch: pytest.MonkeyPatch, filename: str, digest: str) -> None:
    monkeypatch.setattr(fetch_uv, "WHEELS", {fetch_uv.platform.machine(): (filename, digest)})


def test_uv_comes_from_the_index_and_runs(
    fetch_uv: ModuleType, index: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    digest = hashlib.sha256((index / "files" / "uv-1.0-x.whl").read_bytes()).hexdigest()
    pin(fetch_uv, monkeypatch, "uv-1.0-x.whl", digest)
    fetch_uv.main(tmp_path / "cache")
    said = subprocess.run([tmp_path / "cache" / "uv"], capture_output=True, text=True, check=True)
    assert said.stdout == "uv 9.9.9\n"
    assert [path.name for path in (tmp_path / "cache").iterdir()] == ["uv"]


@pytest.mark.parametrize(
    ("filename", "words"), [("uv-1.0-x.whl", "not the file that was pinned"), ("uv-2.0-x.whl", "lists no uv-2.0")]
)
def test_a_changed_or_missing_wheel_is_refused(
    fetch_uv: ModuleType, index: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch, filename: str, words: str
) -> None:
    pin(fetch_uv, monkeypatch, filename, "0" * 64)
    with pytest.raises(SystemExit, match=words):
        fetch_uv.main(tmp_path / "cache")
    assert not (tmp_path / "cache").exists()


def test_no_network_is_said(fetch_uv: ModuleType, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setenv("UV_DEFAULT_INDEX", "http://127.0.0.1:9/simple")
    with pytest.raises(SystemExit, match="Is there a network"):
        fetch_uv.main(tmp_path)


def setup(folder: Path, *arguments: str, path: Path | None = None) -> subprocess.CompletedProcess[str]:
    """``path`` comes before the machine's own programs."""
    command = ["bash", "deploy/setup.sh", *arguments]
    environment = os.environ | ({} if path is None else {"PATH": f"{path}:{os.environ['PATH']}"})
    return subprocess.run(command, cwd=folder, capture_output=True, text=True, timeout=60, check=False, env=environment)


def checkout(folder: Path) -> None:
    """What setup.sh looks at, and an environment."""
    for name in ("uv.lock", "pyproject.toml"):
        shutil.copy(ROOT / name, folder)
    shutil.copytree(ROOT / "deploy", folder / "deploy", ignore=shutil.ignore_patterns("firmware"))
    (folder / ".venv" / "bin").mkdir(parents=True)
    (folder / ".venv" / "bin" / "python").symlink_to(sys.executable)


def test_setup_is_quick_and_silent_where_nothing_is_to_do(tmp_path: Path) -> None:
    checkout(tmp_path)
    stamp = (
        'echo "$(cat uv.lock pyproject.toml deploy/setup.sh deploy/wheel_imports.py | sha256sum) $PWD" > .venv/.ready'
    )
    subprocess.run(["bash", "-c", stamp], cwd=tmp_path, check=True)
    outcome = setup(tmp_path, path=without_uv(tmp_path))
    assert (outcome.returncode, outcome.stdout, outcome.stderr) == (0, "", "")
    assert not (tmp_path / "asked").exists()


def without_uv(folder: Path) -> Path:
    """Where a program lies that stands for uv, can do nothing, and notes what it is asked."""
    uv = folder / "bin" / "uv"
    uv.parent.mkdir()
    uv.write_text('#!/bin/sh\necho "$@" >asked\n[ "$1" = --version ] && echo uv 9.9.9 && exit 0\nexit 1\n')
    uv.chmod(0o755)
    return uv.parent


def test_an_optional_part_is_asked_for_again_by_every_later_setup(tmp_path: Path) -> None:
    checkout(tmp_path)
    (tmp_path / ".venv" / ".extras").write_text("heic\n")
    assert setup(tmp_path, "--extra", "usd", path=without_uv(tmp_path)).returncode == 1
    assert (tmp_path / "asked").read_text().split()[-2:] == ["--extra=heic", "--extra=usd"]
    assert (tmp_path / ".venv" / ".extras").read_text() == "heic\n", "what could not be had is not remembered"


def test_setup_refuses_an_unknown_option() -> None:
    outcome = setup(ROOT, "--everything")
    assert outcome.returncode == 1
    assert "--everything" in outcome.stderr


SKIPPING = """
import pytest

def test_runs():
    pass

def test_wants_a_device():
    pytest.skip("no device")
"""


@pytest.mark.parametrize(
    ("ci", "allowed", "status"),
    [
        ("", "", 0),
        ("true", "", 1),
        ("true", "*::test_wants_*  a device of the operator's", 0),
        ("true", "*::test_runs x", 1),
    ],
)
def test_a_skip_that_no_list_names_fails_in_ci(tmp_path: Path, ci: str, allowed: str, status: int) -> None:
    shutil.copy(ROOT / "tests" / "conftest.py", tmp_path)
    (tmp_path / "allowed_skips.txt").write_text(f"# a comment\n{allowed}\n")
    (tmp_path / "test_it.py").write_text(SKIPPING)
    (tmp_path / "pytest.ini").write_text("[pytest]\nmarkers = gl: needs an EGL context\n")
    command = [sys.executable, "-m", "pytest", "-q", "-p", "no:cacheprovider", str(tmp_path)]
    environment = os.environ | {"CI": ci, "PYTHONPATH": str(ROOT), "PYTEST_DISABLE_PLUGIN_AUTOLOAD": "1"}
    outcome = subprocess.run(
        command, cwd=tmp_path, env=environment, capture_output=True, text=True, timeout=60, check=False
    )
    assert outcome.returncode == status, outcome.stdout
    assert ("no device" in outcome.stdout) == (status == 1)
