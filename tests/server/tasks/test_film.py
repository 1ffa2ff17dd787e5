"""What a film is, how an uploaded one is checked, and how far its job is."""

from pathlib import Path

import cv2
import numpy as np
import pytest

from rig.errors import InputError
from rig.formats.cameras.cameras_json import read_rig
from rig.formats.pictures.images import write_image
from server.tasks.film import FilmProgress, ingest_film, is_film
from tests.support.services import small_capture

SIZE = 24


@pytest.fixture
def videos(tmp_path: Path) -> Path:
    """Three cameras' videos of four frames of noise, beside a file that belongs to no film."""
    folder = small_capture(tmp_path / "film", size=SIZE)
    (folder / "videos").mkdir()
    for path in sorted((folder / "images").iterdir()):
        reel = cv2.VideoWriter(
            str(folder / "videos" / f"{path.stem}.avi"), cv2.VideoWriter.fourcc(*"MJPG"), 25.0, (SIZE, SIZE)
        )
        for seed in range(4):
            reel.write(np.random.default_rng(seed).integers(0, 256, (SIZE, SIZE, 3), dtype=np.uint8))
        reel.release()
        path.unlink()
    (folder / "notes.txt").write_text("of nobody")
    return folder


def silent(stage: str, fraction: float) -> None:
    pass


def test_a_film_has_videos_or_several_pictures_of_two_cameras(videos: Path, tmp_path: Path) -> None:
    shot = small_capture(tmp_path / "shot")
    assert (is_film(videos), is_film(shot)) == (True, False)
    for name, count in (("cam00", 3), ("cam01", 1)):
        for number in range(count):
            write_image(shot / "images" / name / f"{number}.png", np.zeros((SIZE, SIZE, 3), np.uint8))
    assert not is_film(shot)  # one camera's folder with several pictures is an error of a shot
    write_image(shot / "images" / "cam01" / "1.png", np.zeros((SIZE, SIZE, 3), np.uint8))
    assert is_film(shot)
    (shot / "cameras.json").unlink()
    assert not is_film(shot)  # photographs by which cameras are calibrated


def test_a_films_files_are_taken_and_nothing_else(videos: Path, tmp_path: Path) -> None:
    names = read_rig(videos / "cameras.json").names
    found = ingest_film(videos, tmp_path / "files", SIZE * SIZE, silent)
    plates = [f"background/{name}.png" for name in names]
    assert [*found.inputs] == sorted(["cameras.json", *plates, *(f"videos/{name}.avi" for name in names)])
    there = [path for path in (tmp_path / "files").rglob("*") if path.is_file()]
    assert sorted(path.relative_to(tmp_path / "files").as_posix() for path in there) == [*found.inputs]
    assert (found.frames, found.bytes) == (4, sum(path.stat().st_size for path in there))
    assert [(each.name, each.width, each.height) for each in found.cameras] == [(name, SIZE, SIZE) for name in names]


def test_pictures_too_large_are_named_once_a_folder(videos: Path, tmp_path: Path) -> None:
    with pytest.raises(InputError) as refused:
        ingest_film(videos, tmp_path / "files", SIZE * SIZE - 1, silent)
    named = [(fault.code, fault.parameters["file"]) for fault in refused.value.faults]
    files = ["background/cam00.png", *(f"videos/cam0{k}.avi" for k in range(3))]
    assert sorted(named) == [("picture-too-large", file) for file in files]


def test_progress_follows_the_frames_and_counts_those_of_earlier_attempts() -> None:
    now = 0.0
    progress = FilmProgress(100, clock=lambda: now)
    progress.report("compiling", 0.9)
    assert (progress.progress(), progress.counts()) == (0.0, {"frames": 100, "frames_done": 0})
    progress.report("frame 51 of 100", 0.55)
    assert (progress.stage, progress.counts().get("frames_done")) == ("frames", 50)
    assert progress.progress() == pytest.approx(0.52, abs=0.01)
    now = 20.0
    progress.report("frame 61 of 100", 0.64)
    assert progress.remaining_s() == pytest.approx(80.0)  # ten frames took 20 s
    progress.report("preview", 0.0)
    assert (progress.counts().get("frames_done"), progress.remaining_s()) == (100, 0.0)
    assert progress.progress() == pytest.approx(0.95)
