"""The service whose pages are looked at, and a visit to them."""

from collections.abc import Iterator
from pathlib import Path

import pytest
from playwright.sync_api import Browser

from tests.support.browser import Visit, visit
from tests.support.services import RunningService, running_service


@pytest.fixture
def service(tmp_path: Path) -> Iterator[RunningService]:
    """The tiny work: what is looked at here is the pages."""
    with running_service(tmp_path / "data", console="true") as running:
        yield running


@pytest.fixture
def v(browser: Browser, service: RunningService) -> Iterator[Visit]:
    """A visit that the browser has nothing to complain of in the end."""
    visited = visit(browser, service.url)
    yield visited
    visited.check_clean()
