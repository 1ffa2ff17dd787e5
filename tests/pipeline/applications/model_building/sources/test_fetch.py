"""Fetching a model: what is pinned is what arrives, from a stand-in repository in a local folder."""

import shutil
import subprocess
from pathlib import Path

import numpy as np
import pytest

from pipeline.applications.model_building.sources.fetch import REMOTES, CannotFetch, fetch_model
from pipeline.applications.model_building.sources.imports import CannotImport
from pipeline.head_model.model import load_model, model_info
from rig.errors import Cancelled
from tests.support.shared_data import shared

pytestmark = pytest.mark.skipif(shutil.which("git") is None, reason="git is not installed")


def git(folder: Path, *arguments: str) -> str:
    who = ("-c", "user.name=Stand-in", "-c", "user.email=stand-in@example.org", "-c", "commit.gpgsign=false")
    command = ["git", *who, *arguments]
    done = subprocess.run(command, cwd=folder, check=True, capture_output=True, text=True, timeout=60)
    return done.stdout.strip()


def committed(folder: Path, message: str) -> str:
    git(folder, "add", "-A")
    git(folder, "commit", "-q", "-m", message)
    return git(folder, "rev-parse", "HEAD")


@pytest.fixture
def models(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Path:
    folder = tmp_path / "models"
    monkeypatch.setenv("EIGENHEAD_MODELS", str(folder))
    return folder


@pytest.fixture
def empty_repository(tmp_path: Path) -> tuple[Path, str]:
    """A repository with a licence and no model; enough for everything that must fail before the import."""
    folder = tmp_path / "stand-in"
    folder.mkdir()
    git(folder, "init", "-q")
    (folder / "LICENSE").write_text("MIT License\n")
    return folder, committed(folder, "first")


def write_obj(path: Path, vertices: np.ndarray, faces: np.ndarray) -> None:
    with path.open("w") as file:
        file.writelines(f"v {x:.6f} {y:.6f} {z:.6f}\n" for x, y, z in vertices)
        file.writelines(f"f {a + 1}/1/1 {b + 1}/1/1 {c + 1}/1/1\n" for a, b, c in faces)


@pytest.mark.slow
def test_the_pinned_commit_becomes_a_model(tmp_path: Path, models: Path) -> None:
    """An older commit than the branch's end is fetched, and only the folders that are needed."""
    compact = np.load(shared("data/ict-facekit/ict_facekit_light.npz"))
    folder = tmp_path / "stand-in"
    inside = folder / "FaceXModel"
    inside.mkdir(parents=True)
    git(folder, "init", "-q")
    (folder / "LICENSE").write_text("MIT License\n\nCopyright (c) 2020 USC ICT\n")
    mean = compact["mean"].astype(float)
    write_obj(inside / "generic_neutral_mesh.obj", mean / 10, compact["faces"])
    for k in range(3):
        write_obj(inside / f"identity{k:03}.obj", (mean + compact["modes"][k].astype(float)) / 10, compact["faces"][:1])
    pinned = committed(folder, "model")
    (inside / "identity000.obj").write_text("spoilt\n")
    committed(folder, "later")
    stages: dict[str, float] = {}
    got = fetch_model("ict-facekit", source=folder, commit=pinned, report=stages.__setitem__)
    assert got.commit == pinned
    assert got.licence_text.startswith("MIT License")
    assert got.path == models / "ict-facekit.npz"
    assert stages["fetching"] == 1.0
    assert stages["reading identity shapes"] == 1.0
    info = model_info(load_model("ict-facekit"))
    assert (info["name"], info["licence"], info["modes"], info["landmarks"]) == ("ict-facekit", "MIT", 3, 26)
    assert info["vertices"] == len(mean)


def test_what_cannot_be_fetched_is_said(tmp_path: Path, models: Path, empty_repository: tuple[Path, str]) -> None:
    folder, commit = empty_repository
    with pytest.raises(CannotFetch, match="git fetch failed"):  # of the commit that is pinned, which it does not have
        fetch_model("ict-facekit", source=folder)
    git(folder, "tag", "-a", "v1", "-m", "one")  # it can be fetched by its hash, and another object is checked out
    with pytest.raises(CannotFetch, match="answered with commit"):
        fetch_model("ict-facekit", source=folder, commit=git(folder, "rev-parse", "v1"))
    with pytest.raises(CannotFetch, match="not among the models known"):
        fetch_model("flame")
    with pytest.raises(CannotFetch, match="40 hex digits"):
        fetch_model("ict-facekit", source=folder, commit="main")
    with pytest.raises(CannotFetch, match="no address"):
        fetch_model("ict-facekit", source="--upload-pack=touch x", commit=commit)
    with pytest.raises(CannotFetch, match="git fetch failed"):
        fetch_model("ict-facekit", source=tmp_path / "nowhere", commit=commit)
    with pytest.raises(CannotImport, match=r"generic_neutral_mesh\.obj"):
        fetch_model("ict-facekit", source=folder, commit=commit)
    with pytest.raises(CannotFetch, match="took more than"):
        fetch_model("ict-facekit", source=folder, commit=commit, timeout_s=-1.0)
    assert not models.exists()


def test_a_cancelled_fetch_leaves_nothing(models: Path, empty_repository: tuple[Path, str]) -> None:
    def cancel(stage: str, fraction: float) -> None:
        raise Cancelled

    folder, commit = empty_repository
    with pytest.raises(Cancelled):
        fetch_model("ict-facekit", source=folder, commit=commit, report=cancel)
    assert not models.exists()


def test_the_real_pin_is_a_full_commit() -> None:
    assert all(len(remote.commit) == 40 and remote.url.startswith("https://") for remote in REMOTES.values())
