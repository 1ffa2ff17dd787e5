"""Pictures of a job's head, kept, and not drawn back into a job that was erased; the first view against a pinhole."""

import shutil
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest
import trimesh

from rig.mesh import Mesh
from server.console import head_pictures
from server.console.head_pictures import GROUND, SIDE, draw_first_view, drawn, head_picture, warm_up
from server.errors import Conflict, NotFound


@pytest.fixture
def service(tmp_path: Path) -> Any:
    """What is asked of a service: the state of a job, and where its files are."""
    (tmp_path / "jobs" / "j1" / "result").mkdir(parents=True)
    jobs = SimpleNamespace(
        state=lambda job: "succeeded" if job == "j1" else "running",
        results=SimpleNamespace(objects=None),
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
    service.jobs.results.objects = object()
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


def ball(colours: np.ndarray | None = None) -> Mesh:
    round_mesh = trimesh.creation.icosphere(subdivisions=5, radius=100.0)
    return Mesh(np.asarray(round_mesh.vertices), np.asarray(round_mesh.faces, np.int32), colours)


def test_a_ball_stands_in_the_middle_as_large_as_the_lens_shows_it() -> None:
    seen = (drawn(ball()) != GROUND).any(axis=2)
    rows, columns = np.flatnonzero(seen.any(axis=1)), np.flatnonzero(seen.any(axis=0))
    # a ball of radius r from 4.25 r fills asin(1 / 4.25) of the 14 degrees to each side
    radius = SIDE / 2 * np.tan(np.arcsin(1 / 4.25)) / np.tan(np.radians(14))
    for found in (rows, columns):
        np.testing.assert_allclose([found[0], found[-1]], [SIDE / 2 - radius, SIDE / 2 + radius], atol=2.0)


def test_the_subjects_left_is_at_the_right_and_their_crown_on_top() -> None:
    place = ball().vertices
    colours = np.full(place.shape, 40, np.uint8)
    colours[place[:, 0] > 0, 0] = 200  # the left half is red
    colours[place[:, 1] > 0, 2] = 200  # the upper one blue
    picture = drawn(ball(colours)).astype(int)
    # the plane x = 0 is turned by 15 degrees to the side that is away from the camera
    middle = SIDE // 2
    assert picture[middle + 120, middle + 120].argmax() == 0
    assert picture[middle - 120, middle - 120].argmax() == 2
    assert picture[middle + 120, middle - 160].std() < 5, "neither: the lower right quarter"


def test_what_faces_the_lamp_is_brighter() -> None:
    picture = drawn(ball(np.full((len(ball().vertices), 3), 100, np.uint8))).astype(int).mean(axis=2)
    middle = SIDE // 2
    assert picture[middle - 180, middle - 60] > picture[middle + 180, middle - 60] + 8, "the lamps hang above"


def test_a_head_without_colours_is_drawn_white_and_stays_within_range() -> None:
    picture = drawn(ball()).astype(int)[SIDE // 2, SIDE // 2 - 150 : SIDE // 2 + 150]
    assert picture.min() > 150
    assert np.abs(np.diff(picture, axis=0)).max() < 20, "what is too bright is white and does not turn dark"
