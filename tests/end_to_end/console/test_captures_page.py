"""Captures in a real browser: archives, sessions, and two pages that show the same."""

import base64
from pathlib import Path

import httpx
import pytest
from playwright.sync_api import Browser, Page, expect

from rig.formats.captures.archive import pack_folder
from tests.support.browser import Visit, keep_screenshots, violations, visit
from tests.support.services import (
    RunningService,
    await_true,
    packed_capture,
    running_service,
    small_capture,
    uploaded_capture,
)

pytestmark = [pytest.mark.slow, pytest.mark.timeout(900)]


def test_an_unusable_archive_shows_every_fault(browser: Browser, service: RunningService, tmp_path: Path) -> None:
    v = visit(browser, service.url)
    page = v.go("/captures")
    expect(page.get_by_text("No captures yet")).to_be_visible()
    good = packed_capture(tmp_path)
    broken = tmp_path / "broken"
    small_capture(broken, 1)
    (broken / "images" / "cam00.png").unlink()
    (broken / "images" / "cam02.png").write_bytes(b"no image")
    pack_folder(broken, tmp_path / "broken.tar")
    page.locator("input[type=file]").set_input_files([tmp_path / "broken.tar"])
    expect(page.get_by_text("refused")).to_be_visible()
    faults = page.locator("ul.faults li")
    expect(faults.filter(has_text="cam00")).to_have_count(1)
    expect(faults.filter(has_text="cam02")).to_have_count(1)
    drop_file(page, "section.page", good)
    expect(page.locator(".thumb img").first).to_be_visible()
    assert [error for error in v.errors if "422" not in error] == []  # the browser itself notes the refused upload


def drop_file(page: Page, selector: str, path: Path) -> None:
    """Drags ``path`` over an element and lets go."""
    make = """([name, text]) => { const held = new DataTransfer();
      held.items.add(new File([Uint8Array.from(atob(text), c => c.charCodeAt(0))], name)); return held; }"""
    held = page.evaluate_handle(make, [path.name, base64.b64encode(path.read_bytes()).decode()])
    for event in ("dragover", "drop"):
        page.dispatch_event(selector, event, {"dataTransfer": held})


def test_two_pages_agree_and_a_removal_is_taken_back_or_for_good(
    browser: Browser, service: RunningService, screenshots: Path, tmp_path: Path
) -> None:
    uploaded_capture(service, tmp_path, 1)
    one, two = visit(browser, service.url), visit(browser, service.url)
    here, there = one.go("/captures"), two.go("/captures")
    expect(there.locator(".row-button")).to_have_count(1)
    uploaded_capture(service, tmp_path, 2)
    for page in (here, there):
        expect(page.locator(".row-button")).to_have_count(2)
    here.locator("#remove").click()
    expect(here.locator("#removal")).to_contain_text("takes the 3 pictures")
    here.locator("#remove-pictures").click()
    for page in (here, there):
        expect(page.locator(".row-button")).to_have_count(1)
    there.get_by_role("button", name="Undo").click()
    for page in (here, there):
        expect(page.locator(".row-button")).to_have_count(2)
    here.locator("#remove").click()
    here.locator("#remove-pictures").click()
    await_true(lambda: len(httpx.get(service.url + "/v1/captures").json()["captures"]) != 2)
    here.locator("#reconstruct").click()
    here.wait_for_url("**/result/*")  # its head opens by itself
    jobs = two.go("/jobs")
    expect(jobs.locator("[data-state=succeeded]")).to_have_count(1)
    jobs.get_by_role("button", name="Remove").click()
    expect(jobs.locator("[data-job]")).to_have_count(0)
    here.get_by_role("button", name="Undo").click()  # on another page
    expect(jobs.locator("[data-state=succeeded]")).to_have_count(1)
    here = one.go("/captures")
    here.locator("#remove").click()
    expect(here.locator("#removal")).to_contain_text("1 head (")
    expect(here.locator("#removal")).to_contain_text("photographs of the face in the overlays would stay")
    keep_screenshots(here, screenshots, "captures-removal")
    here.locator("#erase-capture").click()
    for page in (here, jobs):
        expect(page.locator(".row-button")).to_have_count(0)
    assert httpx.get(service.url + "/v1/jobs").json()["jobs"] == []
    one.check_clean()
    two.check_clean()


def test_a_session_is_filled_and_erased(v: Visit, service: RunningService, screenshots: Path, tmp_path: Path) -> None:
    uploaded_capture(service, tmp_path, 1)
    page = v.go("/captures")
    expect(page.locator(".row-button")).to_have_count(1)
    page.locator("#new-session").click()
    page.get_by_label("Subject").fill("Anna")
    page.get_by_label("Consent").fill("signed 2026-11-21")
    page.get_by_role("button", name="Begin").click()
    expect(page.locator("#session option:checked")).to_have_text("Anna (0)")
    expect(page.get_by_text("No captures in this session yet")).to_be_visible()
    page.locator("input[type=file]").set_input_files([packed_capture(tmp_path, 2)])
    expect(page.locator(".thumb img").first).to_be_visible()
    page.get_by_label("Label").fill("profile")
    page.get_by_label("Expression").fill("smile")
    page.keyboard.press("Tab")
    expect(page.locator(".row-button", has_text="Anna · smile")).to_have_count(1)
    expect(page.locator(".row-button strong")).to_have_text("profile")
    keep_screenshots(page, screenshots, "captures-session")
    rig = v.go("/")
    expect(rig.locator("#session option:checked")).to_have_text("Anna")  # what is shot now belongs to it
    page = v.go("/captures")
    page.locator("#rename").fill("Anna B.")
    page.keyboard.press("Tab")
    expect(page.locator("#session option:checked")).to_have_text("Anna B. (1)")
    page.locator("#method").select_option("simplex")
    page.locator("#reconstruct-all").click()
    expect(page.get_by_text("Queued 1 job.")).to_be_visible()
    job = httpx.get(service.url + "/v1/jobs").json()["jobs"][0]
    assert (job["settings"], job["session"] is not None) == ({"method": "simplex"}, True)
    page.locator("#erase").click()
    page.get_by_role("button", name="Keep").click()
    page.locator("#erase").click()
    page.locator("#erase-for-good").click()
    expect(page.locator("#session option:checked")).to_have_text("all captures")
    expect(page.locator(".row-button strong")).to_have_text("subject 1")
    captures = httpx.get(service.url + "/v1/captures").json()["captures"]
    assert [capture["label"] for capture in captures] == ["subject 1"]
    assert httpx.get(service.url + "/v1/jobs").json()["jobs"] == []
    assert len([*(service.data / "cache/captures").iterdir()]) == 1


def test_consent_is_asked_for_before_the_first_shot(browser: Browser, tmp_path: Path) -> None:
    with running_service(tmp_path / "data", worker=False, console="true", ask_consent="true") as asking:
        v = visit(browser, asking.url)
        page = v.go("/")
        expect(page.locator("article.tile")).to_have_count(11)
        page.keyboard.press("Space")
        dialog = page.get_by_role("dialog")
        expect(dialog).to_contain_text("Consent comes before the first shot")
        assert violations(page) == []
        dialog.get_by_label("Subject").fill("Anna")
        dialog.get_by_label("Consent").fill("signed 2026-11-22")
        dialog.get_by_role("button", name="Go on").click()
        expect(page.locator(".countdown")).to_be_visible()
        page.keyboard.press("Escape")
        expect(page.locator("#session option:checked")).to_have_text("Anna")
        session = httpx.get(asking.url + "/v1/sessions").json()["sessions"][0]
        assert (session["label"], session["consent"]) == ("Anna", "signed 2026-11-22")
        v.check_clean()
