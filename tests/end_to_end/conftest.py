"""What the tests in a browser share."""

from collections.abc import Iterator
from pathlib import Path

import pytest
from playwright.sync_api import Browser

from tests.support.browser import SCREENSHOTS, chromium


@pytest.fixture(scope="module")
def opened_browser() -> Iterator[Browser]:
    with chromium() as opened:
        yield opened


@pytest.fixture
def browser(opened_browser: Browser) -> Iterator[Browser]:
    """Pages left open would ask the studio for pictures, or a service that is gone, until the last test of a file."""
    yield opened_browser
    for context in opened_browser.contexts:
        context.close()


@pytest.fixture(scope="session")
def screenshots() -> Path:
    """``make test-slow`` and CI keep them in out/screenshots."""
    return SCREENSHOTS
