"""Long lists in a real browser: pages, filters, many at once, and a reload that loses nothing."""

from pathlib import Path

import httpx
import pytest
from playwright.sync_api import Browser, Page, expect

from tests.support.browser import keep_widths, visit
from tests.support.services import RunningService, running_service, uploaded_capture

pytestmark = [pytest.mark.slow, pytest.mark.timeout(300)]

JOBS = 120


def test_long_lists_are_paged_filtered_and_changed_at_once(browser: Browser, screenshots: Path, tmp_path: Path) -> None:
    with running_service(tmp_path / "data", worker=False, console="true", jobs_per_key="1000") as service:
        captures = [uploaded_capture(service, tmp_path, seed) for seed in range(3)]
        with httpx.Client(base_url=service.url, timeout=60) as client:
            jobs = [client.post("/v1/jobs", json={"capture_id": captures[n % 3]}).json()["id"] for n in range(JOBS)]
            ended = client.post("/v1/jobs/bulk", json={"action": "cancel", "ids": jobs[:-10]}).json()["done"]
        assert len(ended) == JOBS - 10
        v = visit(browser, service.url)
        check_jobs(v.go("/jobs"), jobs, screenshots)
        check_captures(v.go("/captures"), service, captures, screenshots)
        v.check_clean()


def check_jobs(page: Page, jobs: list[str], screenshots: Path) -> None:
    rows = page.locator("[data-job]")
    expect(rows).to_have_count(60)  # those that wait, in their order, and fifty that ended
    shown = [row.get_attribute("data-job") for row in rows.all()]
    assert shown[:10] == jobs[-10:]
    assert shown[10:] == jobs[-11:-61:-1]
    page.get_by_role("button", name="Next page").click()
    expect(rows).to_have_count(50)
    assert [row.get_attribute("data-job") for row in rows.all()] == jobs[-61:-111:-1]
    page.get_by_role("button", name="Next page").click()
    expect(rows).to_have_count(10)
    page.get_by_role("button", name="Newer page").click()
    page.locator("#state").select_option("queued")
    expect(rows).to_have_count(10)
    keep_widths(page, screenshots, "jobs-list")
    page.reload()
    expect(page.locator("#state")).to_have_value("queued")
    expect(rows).to_have_count(10)
    page.locator("#pick").click()
    page.get_by_role("button", name="All of this page").click()
    page.locator("#bulk-cancel").click()
    expect(page.get_by_text("10 jobs cancelled.")).to_be_visible()
    expect(rows).to_have_count(0)
    page.locator("#state").select_option("")
    rows.first.focus()
    for _ in range(3):
        page.keyboard.press("ArrowDown")
    expect(rows.nth(3)).to_have_attribute("aria-current", "true")
    listed = page.locator("[data-scroll=jobs]")
    listed.evaluate("list => list.scrollTo(0, 700)")
    page.wait_for_timeout(300)
    page.reload()
    page.wait_for_function("document.querySelector('[data-scroll=jobs]')?.scrollTop === 700")
    expect(rows.nth(3)).to_have_attribute("aria-current", "true")


def check_captures(page: Page, service: RunningService, captures: list[str], screenshots: Path) -> None:
    rows = page.locator("[data-capture]")
    expect(rows).to_have_count(3)
    expect(page.locator("#jobs-of-capture")).to_contain_text(f"all {JOBS // 3}")
    page.locator("#new-session").click()
    page.get_by_label("Subject").fill("Anna")
    page.get_by_label("Consent").fill("signed")
    page.reload()
    expect(page.get_by_label("Subject")).to_have_value("Anna")  # what was typed outlives a reload
    page.get_by_role("button", name="Begin").click()
    expect(page.locator("#session option:checked")).to_have_text("Anna (0)")
    page.locator("#session").select_option("")
    expect(rows).to_have_count(3)
    page.locator("#find").fill("subject 1")
    expect(rows).to_have_count(1)
    page.locator("#find").fill("")
    expect(rows).to_have_count(3)
    page.locator("#pick").click()
    for capture in captures[:2]:
        page.locator(f"input[type=checkbox][value='{capture}']").check()
    page.locator("#tagging").fill("a,\u202eb")
    page.locator("#bulk-tag").click()
    expect(page.get_by_text("tag 2 has control characters")).to_be_visible()
    page.locator("#tagging").fill("Beard, study 4")
    page.locator("#bulk-tag").click()
    expect(page.get_by_text("2 captures tagged.")).to_be_visible()
    page.locator("#tag").select_option("Beard")
    expect(rows).to_have_count(2)
    expect(rows.first).to_contain_text("#Beard #study 4")
    keep_widths(page, screenshots, "captures-tagged")
    page.reload()
    expect(page.locator("#tag")).to_have_value("Beard")
    page.locator("#tags").fill("study 4")
    page.keyboard.press("Tab")
    expect(rows).to_have_count(1)
    page.locator("#tag").select_option("")
    page.locator("#pick").click()
    for capture in captures[:2]:
        page.locator(f"input[type=checkbox][value='{capture}']").check()
    page.locator("#bulk-move").select_option(label="Anna")
    expect(page.get_by_text("2 captures moved.")).to_be_visible()
    expect(page.locator("#session option", has_text="Anna (2)")).to_have_count(1)
    page.locator("#bulk-remove").click()
    expect(rows).to_have_count(1)
    page.get_by_role("button", name="Undo").click()
    expect(rows).to_have_count(3)
    page.get_by_role("button", name="All of this page").click()
    page.locator("#bulk-erase").click()
    page.locator("#bulk-erase-for-good").click()
    expect(page.get_by_text("No captures yet")).to_be_visible()
    assert httpx.get(service.url + "/v1/captures").json()["total"] == 0
    assert httpx.get(service.url + "/v1/jobs").json()["total"] == 0
