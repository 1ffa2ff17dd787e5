"""The screen clock before five free cameras of the studio, and its page."""

import json
import re
from collections.abc import Mapping
from dataclasses import dataclass
from itertools import pairwise
from pathlib import Path

import cv2
import numpy as np
import pytest
from typer.testing import CliRunner

from pipeline.applications.moments.screen_clock import PERIOD, clock_page, draw_row, measure_skews, read_refresh
from server.cli.main import app
from tests.support.browser import chromium

SIZE = (480, 640)  # height and width
CELL_PX = 12  # of the screen
SCREEN_HZ = 60.0


@dataclass(frozen=True)
class FreeCamera:
    """Exposes ``exposure_s`` long, ``rate_hz`` times a second, first at ``first_s``."""

    rate_hz: float
    first_s: float
    exposure_s: float

    def next_begin_s(self, time_s: float) -> float:
        """When the first exposure after a moment begins."""
        return np.ceil((time_s - self.first_s) * self.rate_hz) / self.rate_hz + self.first_s


def photograph_clock(begin_s: float, exposure_s: float, rng: np.random.Generator) -> np.ndarray:
    """The screen from a little aside: refreshes within the exposure are blended, with blur and noise."""
    begin, end = SCREEN_HZ * begin_s, SCREEN_HZ * (begin_s + exposure_s)
    edges = np.unique([begin, *np.arange(np.ceil(begin), end), end])
    shown = np.sum([(b - a) * draw_row(int((a + b) / 2) % PERIOD) for a, b in pairwise(edges)], axis=0)
    screen = cv2.resize(shown / (end - begin), None, fx=CELL_PX, fy=CELL_PX, interpolation=cv2.INTER_NEAREST)
    height, width = screen.shape
    corners = np.array([[0, 0], [width, 0], [width, height], [0, height]], np.float32)
    seen = np.array([[110, 190], [530, 205], [525, 265], [115, 260]]) + rng.normal(0.0, 10.0, (4, 2))
    warp = cv2.getPerspectiveTransform(corners, seen.astype(np.float32))
    picture = cv2.warpPerspective(screen, warp, SIZE[::-1], flags=cv2.INTER_AREA, borderValue=120.0)
    noisy = 0.8 * cv2.GaussianBlur(picture, (0, 0), 0.8) + 20.0 + rng.normal(0.0, 4.0, SIZE)
    return np.clip(noisy, 0, 255).astype(np.uint8)


def true_middles_s(cameras: Mapping[str, FreeCamera], asked_s: np.ndarray) -> dict[str, np.ndarray]:
    """When the middle of each exposure was, of the first pictures after the moments ``asked_s``."""
    return {
        name: np.array([camera.next_begin_s(moment) for moment in asked_s]) + camera.exposure_s / 2
        for name, camera in cameras.items()
    }


# rates as webcams have them, not quite what their boxes say
FREE = {
    "cam0": FreeCamera(25.03, 0.011, 0.005),
    "cam1": FreeCamera(29.97, 0.003, 0.008),
    "cam2": FreeCamera(30.11, 0.030, 0.012),
    "cam3": FreeCamera(24.02, 0.021, 0.007),
    "cam4": FreeCamera(50.07, 0.002, 0.0033),
}


@pytest.mark.parametrize("exposure_s", [0.002, 0.01, 0.02, 0.03])
def test_a_picture_says_the_middle_of_its_exposure(exposure_s: float) -> None:
    rng = np.random.default_rng(3)
    off = []
    for begin_s in rng.uniform(0.0, 100.0, 12):
        refresh = read_refresh(photograph_clock(begin_s, exposure_s, rng))
        assert refresh is not None
        off.append((refresh - SCREEN_HZ * (begin_s + exposure_s / 2) + PERIOD / 2) % PERIOD - PERIOD / 2)
    assert np.abs(off).max() < 0.75  # half a refresh, and blends that are read as one of both


def test_what_is_no_row_is_not_read() -> None:
    assert read_refresh(np.full((480, 640), 200, np.uint8)) is None
    row = cv2.resize(draw_row(7), None, fx=12, fy=12, interpolation=cv2.INTER_NEAREST)
    assert read_refresh(np.pad(row, 40, constant_values=255)) == 7.5
    assert read_refresh(np.pad(row[:, : 3 * 96], 40, constant_values=255)) is None  # markers 0, 1, 2: those of 6, 7, 2


@pytest.fixture(scope="module")
def shots(tmp_path_factory: pytest.TempPathFactory) -> tuple[Path, dict[str, float]]:
    """Forty shots at moments of no order, and the true mean skews, ms."""
    rng, folder = np.random.default_rng(1), tmp_path_factory.mktemp("clock")
    middles = true_middles_s(FREE, np.cumsum(rng.uniform(0.7, 1.3, 40)))
    for name, camera in FREE.items():
        (folder / name).mkdir()
        for number, middle in enumerate(middles[name]):
            picture = photograph_clock(middle - camera.exposure_s / 2, camera.exposure_s, rng)
            cv2.imwrite(str(folder / name / f"{number:03}.png"), picture)
    mean = np.mean([*middles.values()], axis=0)
    return folder, {name: 1000.0 * float((of - mean).mean()) for name, of in middles.items()}


def test_five_free_cameras_are_measured_to_2_ms(shots: tuple[Path, dict[str, float]], tmp_path: Path) -> None:
    folder, skews_ms = shots
    done = CliRunner().invoke(app, ["clock", str(folder), "--out", str(tmp_path / "clock.json"), "--json"])
    assert done.exit_code == 0, done.output
    document = json.loads(done.stdout)
    assert json.loads((tmp_path / "clock.json").read_text()) == document
    for name, skew in document["cameras"].items():
        assert skew["mean_ms"] == pytest.approx(skews_ms[name], abs=2.0)
        assert skew["std_ms"] < 3.0
    assert max(skews_ms.values()) - min(skews_ms.values()) > 8.0


def test_a_camera_that_never_shows_the_clock_is_named(shots: tuple[Path, dict[str, float]], tmp_path: Path) -> None:
    for name in ("a", "b"):
        (tmp_path / name).mkdir()
        cv2.imwrite(str(tmp_path / name / "000.png"), np.full((480, 640), 90, np.uint8))
    done = CliRunner().invoke(app, ["clock", str(tmp_path)])
    assert done.exit_code == 1
    assert [f"{name} shows the clock in no picture" in str(done.exception) for name in ("a", "b")] == [True, True]


def test_cameras_in_step_with_the_screen_state_a_larger_error() -> None:
    skews = measure_skews({"a": np.arange(40.0) * 6 % PERIOD, "b": (np.arange(40.0) * 6 + 1) % PERIOD}, SCREEN_HZ)
    assert skews["b"].mean_ms == pytest.approx(500.0 / SCREEN_HZ)  # from the mean of both
    assert skews["b"].std_ms == pytest.approx(1000.0 / SCREEN_HZ / 12**0.5)


def test_the_page_holds_every_code(tmp_path: Path) -> None:
    done = CliRunner().invoke(app, ["clock", "--page", str(tmp_path / "clock.html")])
    assert done.exit_code == 0, done.output
    text = (tmp_path / "clock.html").read_text(encoding="utf-8")
    assert text == clock_page()
    codes = json.loads(re.findall(r"codes = (\[.*?\])", text)[0])
    assert len(set(codes)) == PERIOD
    again = CliRunner().invoke(app, ["clock", "--page", str(tmp_path / "clock.html")])
    assert again.exit_code == 1


@pytest.mark.slow
def test_the_page_shows_the_refresh_that_it_counts(tmp_path: Path) -> None:
    (tmp_path / "clock.html").write_text(clock_page(), encoding="utf-8")
    with chromium() as browser:
        page = browser.new_page(viewport={"width": 1280, "height": 720})
        page.goto(f"file://{tmp_path / 'clock.html'}")
        for _ in range(5):
            before = page.evaluate("refresh")
            picture = cv2.imdecode(np.frombuffer(page.screenshot(), np.uint8), cv2.IMREAD_GRAYSCALE)
            shown = read_refresh(np.asarray(picture, np.uint8))
            after = page.evaluate("refresh")
            assert shown is not None
            assert (shown - before + 2) % PERIOD < after - before + 4
        page.wait_for_function("parseFloat(document.querySelector('span').textContent) > 10")
