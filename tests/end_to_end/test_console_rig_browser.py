"""The operator's pages before real cameras: four streams and a trigger box, and somebody with a board."""

import re
from collections.abc import Iterator
from pathlib import Path

import cv2
import httpx
import numpy as np
import pytest
from playwright.sync_api import Page, expect

from rig.studio.devices.serve import DeviceFault, StudioDevices
from tests.support.browser import LONG_MS, keep_screenshots, live_rate, visit
from tests.support.services import RunningService
from tests.support.shared_data import shared
from tests.support.studio_pages import StudioPages, studio_pages

pytestmark = [pytest.mark.slow, pytest.mark.timeout(2400)]

NAMES = tuple(f"cam_{i}" for i in range(4))
SHOTS = range(0, 26, 2)
ENDED = re.compile("succeeded|failed|cancelled")


class BoardPictures:
    """Somebody holds the calibration board: one recorded shot at a time, with sensor noise of its own."""

    def __init__(self, folder: Path) -> None:
        self.folder, self.shot = folder, 0
        self._noise = np.random.default_rng(0)

    def __call__(self, camera: str, time_s: float) -> np.ndarray:
        picture = cv2.imread(str(self.folder / camera / f"shot{self.shot:02}.jpg"))
        assert picture is not None
        noisy = picture[:, :, ::-1] + self._noise.standard_normal(picture.shape, np.float32)
        return np.clip(np.round(noisy), 0, 255).astype(np.uint8)

    def hold(self, studio: StudioDevices, shot: int) -> None:
        """From now on the studio's cameras see this shot."""
        studio.seat(False)
        self.shot = shot
        studio.seat(True)


@pytest.fixture
def board() -> BoardPictures:
    return BoardPictures(shared("data/multicam-board"))


@pytest.fixture
def pages(board: BoardPictures, tmp_path: Path) -> Iterator[StudioPages]:
    (tmp_path / "studio").mkdir()
    with studio_pages(
        StudioDevices(tmp_path / "studio", NAMES, board, board), tmp_path / "data", worker=True
    ) as opened:
        yield opened


def test_a_rig_is_calibrated_and_captures(pages: StudioPages, board: BoardPictures, screenshots: Path) -> None:
    """Faults in plain words, clean plates, board shots with their coverage on two pages, the calibration put to use, a
    capture in sync, and a camera that falls silent."""
    browser, service, studio = pages.browser, pages.service, pages.studio
    v = visit(browser, service.url)
    page = v.go("/")
    expect(page.locator("article.tile")).to_have_count(len(NAMES))
    live_rate(page)
    expect(page.get_by_label("State of the rig").get_by_text("no calibration: calibrate the rig")).to_be_visible()
    page.keyboard.press("b")
    expect(page.get_by_text("5 clean plates of 4 cameras")).to_be_visible(timeout=LONG_MS)
    expect(page.locator("#capture")).to_be_enabled()
    page.keyboard.press("Space")
    expect(page.get_by_text("The rig has no calibration: take shots")).to_be_visible(timeout=LONG_MS)
    keep_screenshots(page, screenshots, "rig-uncalibrated")

    page, other = v.go("/calibration"), visit(browser, service.url)
    other.go("/calibration")
    describe_board(page)
    for taken, shot in enumerate(SHOTS, start=1):
        board.hold(studio, shot)
        if taken == 2:
            studio.inject(DeviceFault("hung", "cam_2"))  # a shot of the board may lack a camera
        page.locator("#shoot").click()
        for shown in (page, other.page):
            expect(shown.get_by_text("1 shot" if taken == 1 else f"{taken} shots", exact=True)).to_be_visible(
                timeout=LONG_MS
            )
        studio.clear()
    check_shots(service)
    expect(other.page.get_by_label("Squares across")).to_have_value("4")
    expect(other.page.get_by_label("Squares across")).to_be_disabled()
    live = "c => c.width / c.height > 1.5"  # the cameras' shape, no longer the empty canvas's
    page.wait_for_function(f"[...document.querySelectorAll('.seen canvas')].every({live})")
    keep_screenshots(page, screenshots, "calibration-coverage")
    page.get_by_role("button", name="Take the last one back").click()
    for shown in (page, other.page):
        expect(shown.get_by_text(f"{len(SHOTS) - 1} shots", exact=True)).to_be_visible()
    page.get_by_label("Name of the calibration").fill("four cameras")
    page.locator("#calibrate").click()
    row = page.locator("[data-calibration]")
    expect(row).to_have_attribute("data-state", ENDED, timeout=LONG_MS)
    expect(row).to_have_attribute("data-state", "succeeded")
    (made,) = httpx.get(service.url + "/v1/calibrations").json()["calibrations"]
    assert made["figures"]["rms_px"] <= 1.1
    assert 5 < made["pictures"]["cam_2"] < len(SHOTS) - 1 >= made["pictures"]["cam_3"]
    row.click()
    page.get_by_role("button", name="Use this").click()
    for shown in (page, other.page):
        expect(shown.get_by_text("In use: four cameras")).to_be_visible(timeout=LONG_MS)

    board.hold(studio, 0)
    page = v.go("/")
    expect(page.locator("article.tile").first.get_by_text("calibrated")).to_be_visible()
    page.keyboard.press("Space")
    expect(page.get_by_text("Captured 4 pictures")).to_be_visible(timeout=LONG_MS)
    expect(page.locator("article.tile").get_by_text("in sync")).to_have_count(len(NAMES))
    expect(page.get_by_label("Verdict")).to_be_visible(timeout=LONG_MS)
    page.keyboard.press("k")
    expect(page.get_by_label("Verdict")).to_be_hidden()
    studio.inject(DeviceFault("hung", "cam_1"))
    expect(page.locator("article[data-camera=cam_1]").get_by_text("shows nothing")).to_be_visible(timeout=LONG_MS)
    page.keyboard.press("Space")
    expect(page.get_by_text("The shot is no capture: cam_1")).to_be_visible(timeout=LONG_MS)
    keep_screenshots(page, screenshots, "rig-fault")
    v.check_clean()
    other.check_clean()


def check_shots(service: RunningService) -> None:
    """Of the board no head is made and no feature is picked."""
    shots = httpx.get(service.url + "/v1/captures").json()["captures"]
    assert [shot["board"] for shot in shots] == [True] * len(SHOTS)
    assert httpx.post(service.url + "/v1/jobs", json={"capture_id": shots[0]["id"]}).status_code == 409
    features = f"{service.url}/v1/captures/{shots[0]['id']}/features"
    assert httpx.put(features, json={"points": {}}).status_code == 409


def describe_board(page: Page) -> None:
    for label, value in (("Squares across", "4"), ("Squares down", "5"), ("Square, mm", "54")):
        page.get_by_label(label).fill(value)
    page.get_by_label("White on black").check()
