"""The service's own page: keys made and revoked, what lies on the disk, what goes next."""

from pathlib import Path

import httpx
import pytest
from playwright.sync_api import Browser, Page, expect

from tests.support.attacks import add_keys
from tests.support.browser import keep_widths, visit
from tests.support.services import RunningService, running_service, uploaded_capture

pytestmark = [pytest.mark.slow, pytest.mark.timeout(300)]


def test_keys_are_made_and_revoked_and_what_goes_is_told(browser: Browser, screenshots: Path, tmp_path: Path) -> None:
    with running_service(
        tmp_path / "data", worker=False, console="true", keep_captures_days="30", keep_jobs="1"
    ) as service:
        capture = uploaded_capture(service, tmp_path)
        jobs = [httpx.post(service.url + "/v1/jobs", json={"capture_id": capture}).json()["id"] for _ in range(2)]
        httpx.post(service.url + "/v1/jobs/bulk", json={"action": "cancel", "ids": jobs})
        v = visit(browser, service.url)
        page = v.go("/service")
        check_storage(page, service, capture, jobs)
        expect(page.get_by_text("The first key is made by eigenhead keys add")).to_be_visible()
        expect(page.locator("#new-key")).to_have_count(0)
        (secret,) = add_keys(service, "admin")
        page.wait_for_url("**/sign-in")
        page.get_by_label("API key").fill(secret)
        page.keyboard.press("Enter")
        expect(page.locator("article.tile")).to_have_count(11)
        page = v.go("/service")
        keep_widths(page, screenshots, "service")
        assert service_answers(service, secret) == 200
        assert service_answers(service, None) == 401
        page.reload()
        expect(page.locator("[data-key]")).to_contain_text("yours")  # the browser goes on with it
        assert secret.split("_", 2)[2] not in page.content()
        reader = make(page, "reader", "read")
        other = visit(browser, service.url)
        other.page.goto(service.url + "/service")
        other.page.get_by_label("API key").fill(reader)
        other.page.keyboard.press("Enter")
        expect(other.page.locator("article.tile")).to_have_count(11)
        shown = other.go("/service")
        expect(shown.get_by_text("Your key has no scope admin")).to_be_visible()
        expect(shown.locator("[data-key]")).to_have_count(0)
        expect(shown.locator("#clear")).to_be_disabled()
        page.get_by_role("button", name="Revoke reader").click()
        page.get_by_role("button", name="Revoke for good").click()
        expect(page.locator("[data-key]")).to_have_count(1)
        shown.wait_for_url("**/sign-in")
        assert service_answers(service, reader) == 401
        v.check_clean()
        other.check_clean()


def make(page: Page, name: str, scope: str) -> str:
    page.locator("#new-key").click()
    page.get_by_label("Name").fill(name)
    expect(page.get_by_label(scope)).to_be_checked()
    page.get_by_role("button", name="Make the key").click()
    found = page.get_by_label("The key", exact=True).input_value()
    page.get_by_role("button", name="I have it").click()
    return found


def service_answers(service: RunningService, key: str | None) -> int:
    headers = {} if key is None else {"authorization": f"Bearer {key}"}
    return httpx.get(service.url + "/v1/captures", headers=headers).status_code


def check_storage(page: Page, service: RunningService, capture: str, jobs: list[str]) -> None:
    """Bytes by kind are those of the files; what is over the number of jobs goes at once, the capture in 30 days."""
    files = service.data / "captures"
    size = sum(path.stat().st_size for path in files.rglob("*") if path.is_file())
    row = page.get_by_label("Bytes by kind").locator("tr", has_text="photographs and clean plates")
    expect(row.locator("td").nth(2)).to_have_text(f"{-(-size // 1000)} kB")
    expect(row.locator("td").nth(3)).to_have_text("1")
    following = page.locator("#goes-next tr")
    expect(following).to_have_count(3)
    expect(following.nth(0)).to_contain_text(jobs[0][-6:])
    expect(following.nth(0)).to_contain_text("at the next sweep")
    expect(following.nth(1)).to_contain_text("when more come")
    expect(following.nth(2).get_by_role("link")).to_have_attribute("href", f"/captures?capture={capture}")
    page.locator("#remove-failed").click()
    expect(page.get_by_text("2 removed.")).to_be_visible()
    page.get_by_role("button", name="Undo").click()
