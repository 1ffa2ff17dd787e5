"""What holds on every page: it can be read and used, needs a key where one is set, and outlives its service."""

import time
from collections.abc import Callable
from pathlib import Path

import httpx
import pytest
from playwright.sync_api import Browser, expect

from tests.support.attacks import add_keys
from tests.support.browser import keep_screenshots, violations, visit
from tests.support.services import RunningService, uploaded_capture

pytestmark = [pytest.mark.slow, pytest.mark.timeout(900)]

PATHS = ("/", "/subjects", "/captures", "/features", "/jobs", "/batches", "/result", "/calibration", "/service")


def test_no_page_has_a_violation_dark_or_light_and_each_says_what_to_do(
    browser: Browser, service: RunningService, screenshots: Path, tmp_path: Path
) -> None:
    found = []
    v = visit(browser, service.url)
    for state in ("empty", "filled"):
        for path in PATHS:
            page = v.go(path)
            page.wait_for_timeout(1500)
            found += [f"{state} {path}: {violation}" for violation in violations(page)]
            if path == "/":
                page.keyboard.press("?")
                expect(page.get_by_role("dialog")).to_be_visible()
                found += [f"keys: {violation}" for violation in violations(page)]
                page.keyboard.press("Escape")
            if state == "empty":
                keep_screenshots(page, screenshots, f"empty{path.replace('/', '-').rstrip('-')}")
        if state == "empty":
            capture = uploaded_capture(service, tmp_path)
            httpx.post(service.url + "/v1/jobs", json={"capture_id": capture})
            httpx.post(service.url + "/v1/jobs", json={"capture_id": capture, "settings": {"front": "fail"}})
            httpx.post(service.url + "/v1/batches", json={"captures": [capture], "settings": {"front": "fail"}})
    v.page.locator("#look").click()
    for path in PATHS:
        page = v.go(path)
        page.wait_for_timeout(1000)
        assert page.evaluate("getComputedStyle(document.body).backgroundColor") == "rgb(242, 244, 247)"
        found += [f"light {path}: {violation}" for violation in violations(page)]
        page.screenshot(path=screenshots / f"light{path.replace('/', '-').rstrip('-')}.png")
    assert found == []
    assert v.errors == []


def test_the_first_page_shows_the_rig_and_may_capture(
    browser: Browser, service: RunningService, record_property: Callable[[str, object], None]
) -> None:
    """The best of three fresh browsers is a figure, whose aim is 2 s; it is not asserted, since the slow tests run two
    at a time."""
    took = []
    for _ in range(3):
        v = visit(browser, service.url)
        began = time.monotonic()
        v.go("/")
        expect(v.page.locator("article.tile")).to_have_count(11)
        expect(v.page.locator("#capture")).to_be_enabled()
        took.append(time.monotonic() - began)
        v.page.context.close()
    record_property("seconds to the first page", round(min(took), 2))


def test_a_page_comes_back_after_the_service_was_killed(
    browser: Browser, service: RunningService, tmp_path: Path
) -> None:
    uploaded_capture(service, tmp_path, 1)
    v = visit(browser, service.url)
    page = v.go("/captures")
    expect(page.locator(".row-button")).to_have_count(1)  # sent with the page
    expect(page.get_by_text("GB free")).to_be_visible(timeout=20_000)  # over the socket, which is there now
    service.kill()
    expect(page.locator("#popup")).to_be_visible(timeout=20_000)
    expect(page.locator(".rail .foot .line").first).to_have_text("Connection lost.")  # and not Ready beside it
    service.start()
    uploaded_capture(service, tmp_path, 2)
    expect(page.locator(".row-button")).to_have_count(2, timeout=60_000)
    expect(page.locator("#popup")).to_be_hidden()
    page.locator("#reconstruct").click()  # and it works again
    expect(page.get_by_text("Queued job")).to_be_visible(timeout=30_000)


def test_a_key_is_asked_for_and_stays_out_of_every_address(
    browser: Browser, service: RunningService, tmp_path: Path, screenshots: Path
) -> None:
    uploaded_capture(service, tmp_path)
    (made,) = add_keys(service, "read")
    v = visit(browser, service.url)
    v.page.goto(service.url + "/jobs")
    expect(v.page.get_by_label("API key")).to_be_visible(timeout=30_000)
    assert v.page.url.endswith("/sign-in")
    keep_screenshots(v.page, screenshots, "sign-in")
    for path in ("/console/live", "/console/captures/x/cam00.jpg"):
        assert httpx.get(service.url + path).status_code == 401
    v.page.get_by_label("API key").fill("eh_0123456789ab_wrong")
    v.page.keyboard.press("Enter")
    expect(v.page.get_by_text("No such key")).to_be_visible(timeout=20_000)
    v.page.get_by_label("API key").fill(made)
    v.page.keyboard.press("Enter")
    expect(v.page.locator("article.tile")).to_have_count(11, timeout=30_000)
    page = v.go("/captures")
    expect(page.locator(".thumb img").first).to_be_visible()
    page.locator("#reconstruct").click()
    expect(page.get_by_text("lacks the scope 'submit'")).to_be_visible()
    secret = made.split("_", 2)[2]
    assert all(secret not in address for address in v.addresses)
    stored = b"".join(path.read_bytes() for path in (service.data / "console").iterdir())
    assert secret.encode() not in stored
    assert secret not in service.log.read_text()
    page.goto("about:blank")  # an open page reloads itself as soon as the service is back, beside our own way there
    service.stop()
    service.start()
    v.go("/captures")  # a restart signs nobody out
    expect(v.page.locator(".thumb img").first).to_be_visible(timeout=30_000)


def test_other_web_pages_reach_nothing(service: RunningService) -> None:
    foreign = {"origin": "http://evil.example"}
    assert httpx.get(service.url + "/", headers=foreign).status_code == 403
    assert httpx.get(service.url + "/console/live", headers={"host": "evil.example"}).status_code == 403
    socket = "/_nicegui_ws/socket.io/?EIO=4&transport=polling"
    assert httpx.get(service.url + socket, headers=foreign).status_code == 403
    missing = httpx.get(service.url + "/v1/nothing")
    assert missing.headers["content-type"] == "application/problem+json"
    assert httpx.put(service.url + "/v1/captures").status_code == 405
