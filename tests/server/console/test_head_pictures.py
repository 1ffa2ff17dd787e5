"""Pictures that are drawn of a job's head, kept, and not drawn back into a job that was erased."""

import shutil
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest

from server.console import head_pictures
from server.console.head_pictures import draw_first_view, head_picture, warm_up
from server.errors import Conflict, NotFound


@pytest.fixture
def service(tmp_path: Path) -> Any:
    """What is asked of a service: the state of a job, and where its files are."""
    (tmp_path / "jobs" / "j1" / "result").mkdir(parents=True)
    jobs = SimpleNamespace(
        state=lambda job: "succeeded" if job == "j1" else "running",
        results=SimpleNamespace(elsewhere=False),
        result_folder=lambda job: tmp_path / "fetched",
    )
    return SimpleNamespace(jobs=jobs, store=SimpleNamespace(folder=lambda kind, name: tmp_path / kind / name))


def test_a_picture_is_drawn_once(service: Any, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    drawn: list[Path] = []

    def draw(result: Path) -> np.ndarray:
        drawn.append(result)
        return np.full((8, 8, 3), 90, np.uint8)

    monkeypatch.setitem(head_pictures.DRAWN, "first-view.jpg", draw)
    draw_first_view(service, "j1")
    kept = head_picture(service, "j1", "first-view.jpg")
    assert kept == tmp_path / "jobs" / "j1" / "first-view.jpg"
    assert kept.read_bytes()[:2] == b"\xff\xd8"
    assert drawn == [tmp_path / "jobs" / "j1" / "result"]


def test_a_result_in_a_store_is_fetched_to_be_drawn_and_not_to_be_shown(
    service: Any, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    drawn: list[Path] = []
    monkeypatch.setitem(
        head_pictures.DRAWN, "portrait.jpg", lambda result: (drawn.append(result), np.zeros((8, 8, 3), np.uint8))[1]
    )
    service.jobs.results.elsewhere = True
    for _ in range(2):
        assert head_picture(service, "j1", "portrait.jpg") == tmp_path / "jobs" / "j1" / "portrait.jpg"
    assert drawn == [tmp_path / "fetched"]


def test_a_job_that_is_erased_while_its_head_is_drawn_stays_erased(
    service: Any, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    def draw(result: Path) -> np.ndarray:
        shutil.rmtree(result.parent)
        return np.full((8, 8, 3), 90, np.uint8)

    monkeypatch.setitem(head_pictures.DRAWN, "portrait.jpg", draw)
    with pytest.raises(NotFound):
        head_picture(service, "j1", "portrait.jpg")
    assert not list((tmp_path / "jobs").iterdir())


def test_a_job_that_runs_has_no_picture_and_one_without_a_head_is_passed_over(service: Any) -> None:
    with pytest.raises(Conflict):
        head_picture(service, "j2", "first-view.jpg")
    draw_first_view(service, "j2")
    draw_first_view(service, "j1")  # its result is empty


def test_what_draws_is_loaded_before_a_head_comes() -> None:
    warm_up()
    assert warm_up.cache_info().currsize == 1
