"""A real browser for the operator's pages, and what every page must hold to in it."""

import os
import shutil
import time
from collections.abc import Callable, Iterator, Mapping
from contextlib import contextmanager
from dataclasses import dataclass, field
from functools import cache
from importlib import resources
from pathlib import Path

import pytest
from playwright.sync_api import Browser, ConsoleMessage, Page, ViewportSize, expect, sync_playwright

FLAGS = [
    "--headless",
    "--no-sandbox",
    "--disable-gpu",
    "--use-gl=angle",
    "--use-angle=swiftshader",
    "--disable-quic",
    "--no-first-run",
    "--disable-background-networking",
    "--disable-component-update",
    "--disable-sync",
]
SIZES = {"1366x768": (1366, 768), "3840x2160": (3840, 2160)}
WIDTHS = {"1440": (1440, 900), "1024": (1024, 768), "390": (390, 844)}  # a desk, a tablet, a telephone
LONG_MS = 600_000  # a reconstruction on a machine that is eight times slower
WAIT_MS = 60_000  # whatever a page does at once, on a machine that is eight times slower
SCREENSHOTS = Path(os.environ.get("EIGENHEAD_SCREENSHOTS") or Path(__file__).parents[2] / "out/screenshots")
PATHS = ("/", "/subjects", "/captures", "/features", "/jobs", "/batches", "/result", "/calibration", "/service")

expect.set_options(timeout=WAIT_MS)


@contextmanager
def chromium() -> Iterator[Browser]:
    """Debian's Chromium with an empty profile; skips where it is absent."""
    path = os.environ.get("EIGENHEAD_CHROMIUM") or shutil.which("chromium")
    if path is None:
        pytest.skip("Chromium is not installed (apt-get install chromium)")
    with sync_playwright() as playwright:
        browser = playwright.chromium.launch(executable_path=path, args=FLAGS)
        try:
            yield browser
        finally:
            browser.close()


@dataclass
class Visit:
    """One page of the browser, with everything it complained about and every address it asked for."""

    page: Page
    base: str
    errors: list[str] = field(default_factory=list)
    addresses: list[str] = field(default_factory=list)

    def __post_init__(self) -> None:
        self.page.set_default_timeout(WAIT_MS)
        self.page.on("console", self._console)
        self.page.on("pageerror", lambda error: self.errors.append(f"uncaught: {error}"))
        self.page.on("request", lambda request: self.addresses.append(request.url))
        self.page.on("websocket", lambda socket: self.addresses.append(socket.url))

    def _console(self, message: ConsoleMessage) -> None:
        if message.type == "error":
            self.errors.append(message.text)

    def go(self, path: str) -> Page:
        self.page.goto(self.base + path, wait_until="domcontentloaded")
        self.page.wait_for_selector("section.page")
        return self.page

    def walk(self, fill: Callable[[], object]) -> Iterator[tuple[str, Page]]:
        """Every page before and after ``fill``, each once it shows what the service says, with a name of its own."""
        for state in ("empty", "filled"):
            for path in PATHS:
                page = self.go(path)
                page.wait_for_function("document.querySelector('.rail .foot').textContent.includes('GB')")
                page.wait_for_timeout(500)
                yield f"{state}{path.replace('/', '-').rstrip('-')}", page
            if state == "empty":
                fill()

    def check_clean(self) -> None:
        """No console error, and no address outside the service."""
        assert not self.errors, self.errors
        inside = (self.base, self.base.replace("http", "ws"), "blob:", "data:")
        assert [address for address in self.addresses if not address.startswith(inside)] == []


def visit(browser: Browser, base: str) -> Visit:
    window = ViewportSize(width=1366, height=768)
    context = browser.new_context(viewport=window, accept_downloads=True, color_scheme="dark")
    return Visit(context.new_page(), base)


def keep_screenshots(page: Page, folder: Path, name: str, sizes: Mapping[str, tuple[int, int]] = SIZES) -> None:
    """At each size, which must fit and hold to WCAG as far as axe-core tells; the page stays as it was."""
    folder.mkdir(parents=True, exist_ok=True)
    before = page.viewport_size
    assert before is not None
    for size, (width, height) in sizes.items():
        page.set_viewport_size({"width": width, "height": height})
        page.wait_for_timeout(500)
        page.screenshot(path=folder / f"{name}-{size}.png")
        assert page.evaluate("document.documentElement.scrollWidth <= innerWidth"), f"{name} is too wide at {size}"
        found = violations(page)
        assert not found, f"{name} at {size}: {found}"
    page.set_viewport_size(before)


def keep_widths(page: Page, folder: Path, name: str) -> None:
    keep_screenshots(page, folder, name, WIDTHS)


def live_rate(page: Page, pictures: int = 0) -> float:
    """Waits until the page of the rig is live and each tile has got so many ``pictures``; how many a second that is."""
    count = "[...document.querySelectorAll('article.tile')].map(t => Number(t.dataset.frames))"
    page.wait_for_function(f"{count}.length > 0 && {count}.every(n => n > 0)", timeout=LONG_MS)
    before, began = page.evaluate(count), time.monotonic()
    page.wait_for_function(f"before => {count}.every((n, i) => n >= before[i] + {pictures})", arg=before)
    return pictures / (time.monotonic() - began)


@cache
def _axe_script() -> str:
    """axe-core (MPL-2.0), as the PyPI package axe-playwright-python carries it."""
    return (resources.files("axe_playwright_python") / "axe.min.js").read_text(encoding="utf-8")


def violations(page: Page) -> list[str]:
    """What axe-core finds, of whatever weight, and where."""
    page.evaluate(_axe_script())
    found = page.evaluate("axe.run(document, { resultTypes: ['violations'] }).then(r => r.violations)")
    return [
        f"{v['id']} ({v['impact']}): {v['help']}: " + "; ".join(node["html"][:160] for node in v["nodes"][:4])
        for v in found
    ]
