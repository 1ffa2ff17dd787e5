"""Batches in a real browser: begun, paused, tried again, cancelled; what failed; the ways to jobs, table and sheet."""

from pathlib import Path

import httpx
import pytest
from playwright.sync_api import Browser, expect

from tests.support.browser import keep_widths, violations, visit
from tests.support.services import await_true, running_service, uploaded_capture

pytestmark = [pytest.mark.slow, pytest.mark.timeout(300)]

CAPTURES = 4


def test_a_batch_is_begun_followed_and_tried_again(browser: Browser, screenshots: Path, tmp_path: Path) -> None:
    with running_service(tmp_path / "data", console="true", tiny_s="1.5") as service:
        for seed in range(CAPTURES):
            uploaded_capture(service, tmp_path, seed)
        v = visit(browser, service.url)
        page = v.go("/batches")
        expect(page.get_by_text("No batches yet")).to_be_visible()
        page.locator("#new-batch").click()
        page.locator("#prefix").fill("nobody")
        page.get_by_role("button", name="Begin").click()
        expect(page.get_by_text("no capture of a head was selected")).to_be_visible()
        expect(page.locator("#prefix")).to_have_value("nobody")
        page.locator("#prefix").fill("SUBJECT")
        page.get_by_role("button", name="Begin").click()
        expect(page.get_by_text(f"Batch begun: {CAPTURES} captures.")).to_be_visible()
        expect(page.locator("[data-count=running]")).to_be_visible()
        page.locator("#pause").click()
        expect(page.locator("[data-count=waiting]")).to_be_visible()
        expect(page.locator("[data-count=queued]")).to_have_count(0)
        assert violations(page) == []
        keep_widths(page, screenshots, "batch-paused")
        page.locator("#resume").click()
        expect(page.locator("[data-batch][data-state=finished]")).to_be_visible()
        expect(page.locator("[data-count=succeeded]")).to_contain_text(str(CAPTURES))
        with page.expect_download() as download:
            page.locator("#to-table").click()
        rows = Path(download.value.path()).read_text().splitlines()
        assert (download.value.suggested_filename, len(rows)) == ("heads.csv", CAPTURES + 1)
        sheet = page.request.get(f"{service.url}{page.locator('#to-sheet').get_attribute('href')}")
        assert (sheet.status, f"{CAPTURES} captures:" in sheet.text()) == (200, True)
        page.locator("#to-jobs").click()
        expect(page.locator("[data-job]")).to_have_count(CAPTURES)
        v.check_clean()


def test_what_failed_is_named_and_the_rest_is_cancelled(browser: Browser, screenshots: Path, tmp_path: Path) -> None:
    with running_service(tmp_path / "data", console="true") as service:

        def failed() -> int:
            return httpx.get(service.url + "/v1/jobs", params={"state": "failed"}).json()["total"]

        capture = uploaded_capture(service, tmp_path)
        for front in ("fail", "long"):
            wanted = {"captures": [capture], "label": front, "settings": {"front": front}}
            batch = httpx.post(service.url + "/v1/batches", json=wanted).json()["id"]
            await_true(lambda: failed() == 1)  # of two that wait, either may run first
        v = visit(browser, service.url)
        page = v.go("/batches")
        page.locator("[data-batch]", has_text="fail").last.click()
        expect(page.get_by_role("heading", name="What failed")).to_be_visible()
        expect(page.get_by_text("cam01 sees nobody")).to_be_visible()
        expect(page.get_by_role("link", name="subject 0")).to_be_visible()
        keep_widths(page, screenshots, "batch-failed")
        page.locator("#retry").click()
        expect(page.locator("[data-count=queued]")).to_be_visible()  # behind the long one
        page.locator(f"[data-batch='{batch}']").click()
        page.locator(f"[data-batch='{batch}'][aria-current=true]").wait_for()  # the page shows the one before
        page.locator("#cancel").click()
        page.locator("#cancel-all").click()
        expect(page.locator(f"[data-batch='{batch}'][data-state=cancelled]")).to_be_visible()
        page.locator("#remove").click()
        expect(page.locator(f"[data-batch='{batch}']")).to_have_count(0)
        expect(page.locator("[data-count=failed]")).to_be_visible()
        assert failed() == 2, "the job that failed first stays in the list"
        v.check_clean()
