"""What the tests in a browser share."""

import os
from collections.abc import Iterator
from pathlib import Path

import pytest
from playwright.sync_api import Browser

from tests.support.browser import chromium
from tests.support.services import ROOT


@pytest.fixture(scope="module")
def browser() -> Iterator[Browser]:
    with chromium() as opened:
        yield opened


@pytest.fixture(scope="session")
def screenshots() -> Path:
    """``make test-slow`` and CI keep them in out/screenshots."""
    return Path(os.environ.get("EIGENHEAD_SCREENSHOTS") or ROOT / "out/screenshots")
