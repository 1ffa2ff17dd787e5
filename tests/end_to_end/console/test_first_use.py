"""What somebody meets who has never seen the pages: the tour, and where a first hour with them once stumbled."""

import json
from pathlib import Path

import httpx
import pytest
from playwright.sync_api import Browser, Page, expect

from tests.support.browser import Visit, keep_widths, visit
from tests.support.services import RunningService, packed_capture, running_service, uploaded_capture

pytestmark = [pytest.mark.slow, pytest.mark.timeout(600)]


def test_a_tour_leads_through_four_pages_and_is_over_once_it_was_skipped(
    v: Visit, browser: Browser, service: RunningService, screenshots: Path, tmp_path: Path
) -> None:
    page = v.go("/")
    tour = page.get_by_role("complementary", name="Tour")
    for step, path in enumerate(("/", "/captures", "/jobs", "/result"), start=1):
        page.wait_for_url(f"{service.url}{path}")
        expect(tour).to_have_attribute("data-step", str(step))
        keep_widths(page, screenshots, f"tour-{step}")
        page.locator("#tour-next").click()
    page.wait_for_url(f"{service.url}/")
    expect(page.get_by_text("0 jobs under way")).to_be_attached()
    expect(tour).to_have_count(0)
    page.keyboard.press("?")
    page.locator("#tour-again").click()
    page.locator("#tour-skip").click()
    expect(tour).to_have_count(0)
    v.go("/")
    expect(page.get_by_text("0 jobs under way")).to_be_attached()
    expect(tour).to_have_count(0)
    uploaded_capture(service, tmp_path)
    other = visit(browser, service.url)
    shown = other.go("/")
    expect(shown.get_by_text("0 jobs under way")).to_be_attached()
    expect(shown.get_by_role("complementary", name="Tour")).to_have_count(0)  # this service is at work already
    other.check_clean()


def test_enter_leaves_the_label_and_a_shot_under_way_is_told(browser: Browser, service: RunningService) -> None:
    v = visit(browser, service.url)
    page = v.go("/")
    expect(page.locator("article.tile")).to_have_count(11)
    page.get_by_label("Label").fill("Anna")
    page.keyboard.press("Enter")
    page.keyboard.press("Space")
    expect(page.locator(".countdown")).to_be_visible()
    expect(page.get_by_label("Label")).to_have_value("Anna")
    expect(page.get_by_role("heading", name="Taking the pictures")).to_be_visible()
    expect(page.locator("#taking")).to_contain_text("seats another person")
    expect(page.locator("#taking")).to_contain_text("1 s so far")


def test_the_rigs_page_tells_of_its_job_again_when_one_comes_back(browser: Browser, tmp_path: Path) -> None:
    with running_service(
        tmp_path / "data", work="tests.support.ball_results:work", ball_s="60", console="true"
    ) as service:
        capture = uploaded_capture(service, tmp_path)
        job = httpx.post(service.url + "/v1/jobs", json={"capture_id": capture}).json()["id"]
        v = visit(browser, service.url)
        page = v.go("/")
        begun = json.dumps([{"id": job, "path": "/", "opens": True}])
        page.evaluate("(begun) => sessionStorage.setItem('eigenhead started', begun)", begun)
        v.go("/jobs")
        v.go("/")
        strip = page.get_by_role("status", name="The job that was started here")
        expect(strip).to_be_visible()
        strip.get_by_role("button", name="Close").click()
        expect(strip).to_have_count(0)
        v.go("/")
        expect(page.get_by_text("1 job under way")).to_be_attached()
        expect(strip).to_have_count(0)  # who closed it has it closed
        v.check_clean()


def test_what_is_looked_at_stays_whatever_comes_in(v: Visit, service: RunningService, tmp_path: Path) -> None:
    first = uploaded_capture(service, tmp_path, 1)
    page = v.go("/captures")
    rows = page.locator(".row-button")
    expect(page.get_by_label("Label")).to_have_value("subject 1")
    uploaded_capture(service, tmp_path, 2)
    expect(rows).to_have_count(2)
    page.wait_for_timeout(1500)
    expect(page.get_by_label("Label")).to_have_value("subject 1")
    expect(page.locator(f"[data-capture='{first}']")).to_have_attribute("aria-current", "true")
    page.locator("#remove").click()
    expect(page.locator("#removal")).to_be_visible()
    page.keyboard.press("Escape")
    expect(page.locator("#removal")).to_have_count(0)
    page.locator("#remove").click()
    expect(page.locator("#removal")).to_be_visible()
    page.locator("#reconstruct").click()
    expect(page.locator("#removal")).to_have_count(0)  # it said that no head was made of it


def test_a_missing_page_can_be_left_and_new_things_take_the_cursor(
    v: Visit, service: RunningService, tmp_path: Path
) -> None:
    uploaded_capture(service, tmp_path, 1)
    page = v.go("/captures")
    expect(page.locator(".row-button")).to_have_count(1)
    page.locator("#find").fill("nobody")
    expect(page.get_by_role("heading", name="No capture matches")).to_be_visible()
    expect(page.locator(".lead")).to_have_text("Found: 0")
    page.locator("#seek-all").click()
    expect(page.locator(".row-button")).to_have_count(1)
    page.locator("#new-session").click()
    page.keyboard.type("Anna")
    expect(page.get_by_label("Subject")).to_have_value("Anna")
    page.keyboard.press("Enter")
    expect(page.get_by_role("heading", name="No captures in this session yet")).to_be_visible()
    page.wait_for_function("!location.search.includes('capture=')")  # nothing is shown that the address names
    page.locator("#upload-tags").fill("Study 4, glasses")
    page.locator("input[type=file]").set_input_files(packed_capture(tmp_path, 2))
    expect(page.locator(".row-button")).to_contain_text("#Study 4 #glasses")
    expect(page.locator("#tags")).to_have_value("Study 4, glasses")


def test_numbers_lead_to_pages_wherever_they_choose_no_point(v: Visit, service: RunningService, tmp_path: Path) -> None:
    page = v.go("/features")
    expect(page.get_by_role("heading", name="No captures yet")).to_be_visible()
    page.keyboard.press("5")
    page.wait_for_url("**/jobs*")
    uploaded_capture(service, tmp_path, 1)
    v.go("/features")
    page.wait_for_selector("[data-point]")
    page.keyboard.press("5")
    expect(page.locator("[data-point][aria-current=true]")).to_contain_text("Right corner of the mouth")
    assert badges(page) == 0, "no page is promised by a key that chooses a point"
    page.keyboard.press("9")
    page.wait_for_url("**/service")
    assert badges(page) == 9
    page.locator("#keys").click()
    expect(page.get_by_role("dialog", name="Keys")).to_be_visible()


def badges(page: Page) -> int:
    return page.locator("nav a kbd").count()
