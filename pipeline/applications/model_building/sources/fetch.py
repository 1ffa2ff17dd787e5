"""Downloads the head model ICT-FaceKit Light at one fixed (pinned) git commit into the user's folder of models.

A git commit is a hash over every byte of the files. A download with another commit than the pinned one is refused
before any of its files is read."""

import os
import re
import subprocess
import tempfile
import time
from dataclasses import dataclass
from pathlib import Path
from typing import IO

from pipeline.applications.model_building.sources.imports import import_model
from pipeline.head_model.model_file import ModelParts, save_model
from pipeline.head_model.model_names import models_folder
from rig.errors import EigenheadError
from rig.progress import Progress, discard_progress


@dataclass(frozen=True, slots=True)
class Remote:
    """Describes the git repository of a published model, and the commit with which this project was tested."""

    url: str
    commit: str  # 40 hex digits
    licence_file: str
    needed: tuple[str, ...]  # folders and files that are fetched


REMOTES = {
    "ict-facekit": Remote(
        url="https://github.com/ICT-VGL/ICT-FaceKit",
        commit="01f6c9743d7c96c6a0a0b5a618049cd0242fd526",
        licence_file="LICENSE",
        needed=("LICENSE", "FaceXModel"),
    )
}
_PROGRESS = re.compile(rb"Receiving objects:\s+(\d+)%")


class CannotFetch(EigenheadError):
    """Reports a model that could not be downloaded at its pinned commit."""

    def __init__(self, name: str, why: str) -> None:
        super().__init__(
            f"{name} could not be fetched: {why}. Fetch its repository by other means and run "
            "`eigenhead model import FOLDER`"
        )


@dataclass(frozen=True, slots=True, eq=False)
class Fetched:
    """Holds a downloaded model: its file, its content, and the licence text to show."""

    path: Path
    parts: ModelParts
    licence_text: str
    commit: str


def fetch_model(
    name: str,
    *,
    source: str | Path | None = None,
    commit: str | None = None,
    timeout_s: float = 1800.0,
    report: Progress = discard_progress,
) -> Fetched:
    """Downloads the named model and saves it below ``models_folder()``.

    ``source`` is another git URL or a local git folder, used as a mirror; the pinned commit is required there too,
    unless ``commit`` names another. Raises CannotFetch, and CannotImport if the repository is not laid out as
    ICT-FaceKit's."""
    remote = REMOTES.get(name)
    if remote is None:
        raise CannotFetch(name, f"it is not among the models known here ({', '.join(sorted(REMOTES))})")
    wanted = commit or remote.commit
    if not re.fullmatch(r"[0-9a-f]{40}", wanted):
        raise CannotFetch(name, f"{wanted!r} is no full commit of 40 hex digits")
    url = str(source) if source is not None else remote.url
    if url.startswith("-"):
        raise CannotFetch(name, f"{url!r} is no address")
    with tempfile.TemporaryDirectory(prefix="eigenhead-fetch-") as scratch:
        folder = Path(scratch)
        _check_out(name, url, wanted, remote, folder, timeout_s=timeout_s, report=report)
        licence_text = _licence(name, folder / remote.licence_file)
        parts = import_model(folder, name=name, report=report)
    path = models_folder() / f"{name}.npz"
    save_model(path, parts)
    return Fetched(path, parts, licence_text, wanted)


def _check_out(
    name: str, url: str, commit: str, remote: Remote, folder: Path, *, timeout_s: float, report: Progress
) -> None:
    """Checks out only the needed files of the pinned commit into ``folder``, without history."""
    report("fetching", 0.0)
    place = str(Path(url).resolve()) if Path(url).exists() else url
    _git(name, folder, timeout_s, "init", "--quiet")
    _git(name, folder, timeout_s, "remote", "add", "origin", place)
    _git(name, folder, timeout_s, "sparse-checkout", "set", "--no-cone", *(f"/{path}" for path in remote.needed))
    fetching = ("fetch", "--progress", "--depth=1", "--filter=blob:none", "origin", commit)
    _git(name, folder, timeout_s, *fetching, report=report)
    _git(name, folder, timeout_s, "checkout", "--progress", "--detach", "FETCH_HEAD", report=report)
    found = _git(name, folder, timeout_s, "rev-parse", "HEAD").strip()
    if found != commit:
        raise CannotFetch(name, f"{url} answered with commit {found}, pinned is {commit}")
    report("fetching", 1.0)


def _git(name: str, folder: Path, timeout_s: float, *arguments: str, report: Progress = discard_progress) -> str:
    """Runs one git command and returns its output. Git never asks for a password; its progress lines are reported."""
    environment = os.environ | {"GIT_TERMINAL_PROMPT": "0", "LC_ALL": "C", "GIT_LFS_SKIP_SMUDGE": "1"}
    try:
        with (folder.parent / f"{folder.name}.log").open("w+b") as errors:
            process = subprocess.Popen(
                ["git", *arguments], cwd=folder, env=environment, stdout=subprocess.PIPE, stderr=errors
            )
            with process:
                try:
                    out = _waited(process, errors, time.monotonic() + timeout_s, report)
                except BaseException:  # also where the report cancels: git must not go on downloading
                    process.kill()
                    raise
            errors.seek(0)
            said = errors.read().decode(errors="replace").splitlines()
    except FileNotFoundError:
        raise CannotFetch(name, "git is not installed") from None
    except subprocess.TimeoutExpired:
        raise CannotFetch(name, f"git {arguments[0]} took more than {timeout_s:.0f} s") from None
    finally:
        (folder.parent / f"{folder.name}.log").unlink(missing_ok=True)
    if process.returncode:
        lines = [line for line in said if "fatal" in line or "error" in line]
        raise CannotFetch(name, f"git {arguments[0]} failed ({'; '.join(lines) or process.returncode})")
    return out.decode(errors="replace")


def _waited(process: subprocess.Popen[bytes], errors: IO[bytes], until: float, report: Progress) -> bytes:
    """Waits for a process, reporting its progress lines, and returns its standard output. Raises TimeoutExpired."""
    while True:
        try:
            return process.communicate(timeout=min(0.25, until - time.monotonic()))[0]
        except subprocess.TimeoutExpired:
            if time.monotonic() > until:
                raise
        errors.seek(0)
        seen = _PROGRESS.findall(errors.read())
        report("fetching", int(seen[-1]) / 100 if seen else 0.0)


def _licence(name: str, path: Path) -> str:
    if not path.is_file():
        raise CannotFetch(name, f"its repository carries no {path.name}")
    return path.read_text(encoding="utf-8", errors="replace")
