"""What the pages fetch by address: every address asks who the session is, pictures are small, upright and whole."""

import inspect
from pathlib import Path

import numpy as np
import pytest
from fastapi.routing import APIRoute
from nicegui import app as pages
from PIL import Image

from rig.formats.pictures.images import read_image, write_image
from server.console import media
from server.console.media import THUMBNAIL_WIDTH, make_thumbnail
from server.errors import NotFound
from server.services.captures import picture_name
from tests.support.at_once import run_at_once
from tests.support.stored_captures import capture_record

ROUTES = [
    route for route in pages.routes if isinstance(route, APIRoute) and route.endpoint.__module__ == media.__name__
]


def scope_of(route: APIRoute) -> str:
    """What the session must be allowed to do, from the dependency's closure."""
    (authenticate,) = (dependency.call for dependency in route.dependant.dependencies)
    assert authenticate is not None
    return inspect.getclosurevars(authenticate).nonlocals["scope"]


def test_every_address_asks_for_a_session_and_hides_no_other() -> None:
    assert len(ROUTES) >= 20
    for route in ROUTES:
        assert route.path.startswith("/console/")
        assert scope_of(route) == ("capture" if route.methods == {"POST"} else "read"), route.path
    # `/console/jobs/{job}/{name}` takes what no other takes, so that it comes last of its kind.
    of_jobs = [route.path for route in ROUTES if route.path.startswith("/console/jobs/{job_id}/")]
    assert of_jobs[-1] == "/console/jobs/{job_id}/{name}"
    assert len(of_jobs) == len(set(of_jobs)) > 6


@pytest.mark.parametrize(("width", "height"), [(2400, 1600), (1600, 2400), (300, 200)])
def test_a_thumbnail_is_narrow_and_keeps_the_pictures_shape(tmp_path: Path, width: int, height: int) -> None:
    picture = np.zeros((height, width, 3), np.uint8)
    picture[: height // 2] = (200, 40, 40)
    picture[height // 2 :, : width // 2] = (40, 200, 40)
    write_image(tmp_path / "cam00.png", picture)
    target = tmp_path / "small" / "cam00.jpg"
    make_thumbnail(tmp_path / "cam00.png", target)
    with Image.open(target) as small:
        assert small.format == "JPEG"
        assert small.width == min(width, THUMBNAIL_WIDTH)
        assert small.width / small.height == pytest.approx(width / height, rel=0.01)
    colours = read_image(target).astype(int)
    h, w = colours.shape[:2]
    assert colours[h // 4, w // 2].argmax() == 0
    assert colours[3 * h // 4, w // 4].argmax() == 1
    assert colours[3 * h // 4, 3 * w // 4].max() < 20


def test_two_that_ask_at_once_get_a_whole_picture(tmp_path: Path) -> None:
    write_image(tmp_path / "cam00.png", np.random.default_rng(1).integers(0, 256, (900, 1200, 3), dtype=np.uint8))
    target = tmp_path / "small" / "cam00.jpg"
    run_at_once(lambda: make_thumbnail(tmp_path / "cam00.png", target), 4)
    assert [path.name for path in target.parent.iterdir()] == ["cam00.jpg"], "no unfinished file is left"
    assert read_image(target).shape == (360, 480, 3)


def test_a_camera_is_found_by_its_name_alone() -> None:
    record = capture_record(inputs=dict.fromkeys(["background/cam01.png", "cameras.json", "images/cam01.png"], ""))
    assert picture_name(record, "images", "cam01") == "images/cam01.png"
    for other in ("cam1", "../images/cam01", "cam01.png", ""):
        with pytest.raises(NotFound):
            picture_name(record, "images", other)
