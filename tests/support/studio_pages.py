"""The operator's pages before a served studio, its cameras and trigger box."""

from collections.abc import Iterator
from contextlib import contextmanager
from dataclasses import dataclass
from pathlib import Path

from playwright.sync_api import Browser

from rig.studio.devices.serve import StudioDevices
from tests.support.browser import chromium
from tests.support.services import RunningService, running_service


@dataclass(frozen=True)
class StudioPages:
    studio: StudioDevices
    browser: Browser
    service: RunningService


@contextmanager
def studio_pages(studio: StudioDevices, data: Path, *, worker: bool) -> Iterator[StudioPages]:
    """Serves ``studio``. The browser is opened after it and closed before it: both run an event loop of their own in
    this thread."""
    with (
        studio,
        chromium() as browser,
        running_service(data, worker=worker, console="true", rig=str(studio.folder / "rig.toml")) as service,
    ):
        yield StudioPages(studio, browser, service)
