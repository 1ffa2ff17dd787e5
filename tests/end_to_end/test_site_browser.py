"""The site's first page, which is the README, in a browser: pictures, and two screens at most."""

import subprocess
import sys
from pathlib import Path

import pytest
from playwright.sync_api import Browser

from tests.support.services import ROOT

SCREEN_PX = (1920, 1080)
SCREENS_MOST = 2

pytestmark = pytest.mark.slow


def test_the_readme_has_pictures_and_fits_two_screens(browser: Browser, tmp_path: Path, screenshots: Path) -> None:
    pytest.importorskip("mkdocs", reason="deploy/setup.sh --docs installs it")
    command = [sys.executable, "-P", "-m", "mkdocs", "build", "--quiet", "--site-dir", str(tmp_path)]
    subprocess.run(command, cwd=ROOT, check=True, capture_output=True, timeout=120)
    page = browser.new_page(viewport={"width": SCREEN_PX[0], "height": SCREEN_PX[1]})
    page.goto((tmp_path / "index.html").as_uri())
    drawn = page.evaluate("[...document.querySelectorAll('article img')].map(image => image.naturalWidth)")
    assert len(drawn) >= 2
    assert all(drawn)
    page.screenshot(path=screenshots / "readme.png", full_page=True)
    height_px = page.evaluate("document.querySelector('article').getBoundingClientRect().height")
    assert 0 < height_px <= SCREENS_MOST * SCREEN_PX[1]
