"""The rig's page with the live head, in a browser: lamps, words, the head, and the shot that is taken by itself."""

from pathlib import Path

import httpx
import pytest
from playwright.sync_api import expect

from tests.server.services.live.conftest import drawn_rig
from tests.support.browser import SCREENSHOTS, chromium, keep_screenshots, keep_widths, visit
from tests.support.services import running_service

pytestmark = [pytest.mark.slow, pytest.mark.timeout(400)]
LONG_MS = 240_000


def test_the_page_says_what_to_do_and_captures_when_the_head_is_steady(tmp_path: Path) -> None:
    with (
        drawn_rig(tmp_path / "studio") as rig,
        chromium() as browser,
        running_service(tmp_path / "data", worker=False, console="true", rig=str(rig.toml)) as service,
    ):
        v = visit(browser, service.url)
        page = v.go("/")
        page.get_by_role("button", name="Skip the tour").click()
        expect(page.locator("[data-code=live-nobody]")).to_be_visible(timeout=LONG_MS)
        rig.devices.seat(True)
        expect(page.locator("[data-code=live-nobody]")).to_be_hidden(timeout=LONG_MS)
        front = page.locator("article[data-camera=cam0]")
        for lamp in ("face", "exposed", "centred", "looking"):
            expect(front.locator(f"[data-lamp={lamp}].good")).to_be_visible(timeout=LONG_MS)
        drawn = "c => { const d = c.getContext('2d').getImageData(0, 0, c.width, c.height).data; "
        drawn += "return d.filter((x, i) => i % 4 === 3 && x > 0).length }"
        assert page.locator("#live-head canvas").evaluate(drawn) > 1000, "pixels of the head"

        rig.turn(30.0)
        expect(page.locator("[data-code=live-turn-right]")).to_contain_text("turn right by")
        page.get_by_label("Capture once when steady").check()
        keep_screenshots(page, SCREENSHOTS, "live-turned")
        page.wait_for_timeout(2500)
        assert captures(service.url) == 0, "it waits for the subject"
        rig.turn(0.0)
        expect(page.locator("[data-shot]")).to_be_visible(timeout=LONG_MS)
        page.keyboard.press("k")
        expect(page.locator("[data-shot]")).to_be_hidden()
        expect(page.get_by_label("Capture once when steady")).not_to_be_checked()
        expect(front.locator("[data-lamp=face].good")).to_be_visible(timeout=LONG_MS)
        page.wait_for_timeout(2500)
        assert captures(service.url) == 1, "it captures once"
        keep_screenshots(page, SCREENSHOTS, "live-good")
        keep_widths(page, SCREENSHOTS, "live-good")
        v.check_clean()


def captures(url: str) -> int:
    return len(httpx.get(f"{url}/v1/captures").json()["captures"])
