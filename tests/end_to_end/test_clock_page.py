"""The page of the screen clock in a real browser, read as a camera reads it."""

from pathlib import Path

import cv2
import numpy as np
import pytest
from playwright.sync_api import Browser

from rig.acquisition.screen_clock import PERIOD, clock_page, read_refresh

pytestmark = pytest.mark.slow


def test_the_page_shows_the_refresh_that_it_counts(browser: Browser, tmp_path: Path) -> None:
    (tmp_path / "clock.html").write_text(clock_page(), encoding="utf-8")
    page = browser.new_page(viewport={"width": 1280, "height": 720})
    page.goto(f"file://{tmp_path / 'clock.html'}")
    for _ in range(5):
        before = page.evaluate("refresh")
        shown = read_refresh(cv2.imdecode(np.frombuffer(page.screenshot(), np.uint8), cv2.IMREAD_GRAYSCALE))
        after = page.evaluate("refresh")
        assert shown is not None
        assert (shown - before + 2) % PERIOD < after - before + 4
    page.wait_for_function("parseFloat(document.querySelector('span').textContent) > 10")
