"""From the shutter to the operator's decision, in a real browser: four streams and a box, with faults planted."""

import time
from collections.abc import Callable, Iterator
from pathlib import Path

import httpx
import pytest
from playwright.sync_api import Page, expect

from rig.formats.cameras.cameras_json import write_rig
from rig.studio.devices.serve import DeviceFault, StudioDevices
from tests.rig.acquisition.test_session import flat_rig
from tests.support.browser import keep_screenshots, live_rate, visit
from tests.support.studio_pages import StudioPages, studio_pages
from tests.support.textured_studio import NAMES as ALL_NAMES
from tests.support.textured_studio import FlatStudio

NAMES = ALL_NAMES[:4]  # the box answers late where one process draws eleven streams beside the browser

pytestmark = [pytest.mark.slow, pytest.mark.timeout(300)]


@pytest.fixture
def pages(tmp_path: Path) -> Iterator[StudioPages]:
    folder = tmp_path / "studio"
    write_rig(flat_rig(NAMES), folder / "cameras.json")
    studio = StudioDevices(folder, NAMES, FlatStudio(False), FlatStudio(True), calibration="cameras.json")
    with studio_pages(studio, tmp_path / "data", worker=False) as opened:
        yield opened


def test_plates_are_judged_and_a_shot_is_kept_retaken_or_reconstructed(
    pages: StudioPages, screenshots: Path, record_property: Callable[[str, object], None]
) -> None:
    """Clean plates with somebody in them are refused, used all the same, and taken back with one click; a shot with a
    moved camera is named, retaken (which removes it), and the good one reconstructed, each with one key."""
    studio, rig_service = pages.studio, pages.service
    v = visit(pages.browser, rig_service.url)
    page = v.go("/")
    expect(page.locator("article.tile")).to_have_count(len(NAMES))
    take_plates(page, studio)
    refuse_plates(page, studio, screenshots)
    studio.inject(DeviceFault("bumped", "cam03"))
    page.keyboard.press("Space")
    expect(page.locator(".countdown")).to_be_visible()
    expect(page.get_by_text("Capturing ...")).to_be_visible()
    began = time.monotonic()
    expect(page.locator("[data-verdict=usable]")).to_be_visible()
    record_property("seconds from the shutter to the verdict, streams of 320 x 240", round(time.monotonic() - began, 2))
    moved = page.locator("[data-fault=moved]")
    expect(moved).to_contain_text("cam03: moved")
    expect(moved).to_contain_text("calibrate again")
    expect(page.locator("[data-shot] .thumb[data-camera=cam03]")).to_contain_text("moved")
    expect(page.locator("[data-shot] svg.outline")).not_to_have_count(0)
    keep_screenshots(page, screenshots, "shot-usable")
    studio.clear()
    page.keyboard.press("r")
    expect(page.locator(".countdown")).to_be_visible()
    expect(page.get_by_text("Removed: the 4 pictures of capture")).to_be_visible()
    expect(page.locator("[data-verdict=good]")).to_be_visible()
    keep_screenshots(page, screenshots, "shot-good")
    page.keyboard.press("Enter")
    expect(page.get_by_text("Queued job")).to_be_visible()
    expect(page.locator("[data-shot]")).to_have_count(0)
    captures = httpx.get(rig_service.url + "/v1/captures").json()["captures"]
    assert [capture["verdict"] for capture in captures if capture["verdict"] != "usable"] == ["good"]
    v.check_clean()


def take_plates(page: Page, studio: StudioDevices) -> None:
    live_rate(page)
    page.keyboard.press("b")
    expect(page.get_by_text(f"5 clean plates of {len(NAMES)} cameras")).to_be_visible()
    studio.seat(True)


def refuse_plates(page: Page, studio: StudioDevices, screenshots: Path) -> None:
    """The sitter stays in the seat while B is pressed."""
    page.keyboard.press("b")
    dialog = page.locator("#refused-plates")
    expect(dialog).to_contain_text("Somebody seems to be in the new clean plates")
    expect(dialog.locator("summary")).to_have_text(f"{len(NAMES)} cameras differ")
    keep_screenshots(page, screenshots, "plates-refused")
    page.locator("#use-refused").click()
    expect(dialog).to_have_count(0)
    page.locator("#undo-plates").click()
    expect(page.get_by_text("These clean plates are in use now")).to_have_count(2)
    dialog.get_by_role("button", name="Keep the old ones").click()
    expect(dialog).to_have_count(0)
