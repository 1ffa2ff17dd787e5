"""A head that is ready, in the tab that began its job: opened, or told of where somebody types."""

import re
from pathlib import Path

import httpx
import pytest
from playwright.sync_api import Browser, expect

from tests.support.browser import keep_widths, visit
from tests.support.services import running_service, uploaded_capture

pytestmark = [pytest.mark.slow, pytest.mark.timeout(300)]

TONES = """window.tones = 0; const start = OscillatorNode.prototype.start;
  OscillatorNode.prototype.start = function (...when) { window.tones += 1; return start.apply(this, when); };"""


def test_a_head_opens_where_it_began_and_never_over_typing(browser: Browser, screenshots: Path, tmp_path: Path) -> None:
    work = "tests.support.ball_results:work"
    with running_service(tmp_path / "data", work=work, ball_s="1", console="true") as service:
        capture = uploaded_capture(service, tmp_path)
        assert capture in httpx.get(service.url + "/captures").text, "a page is sent with its state"
        mine, other = visit(browser, service.url), visit(browser, service.url)
        mine.page.add_init_script(TONES)
        page, elsewhere = mine.go("/captures"), other.go("/captures")
        page.locator("#reconstruct").click()
        expect(page).to_have_title(re.compile(r"^\d+ % Captures - eigenhead$"))
        page.wait_for_url("**/result/*")
        page.wait_for_selector("canvas[data-loaded$=head]")
        head = page.url.rpartition("/")[2]
        assert (service.data / "jobs" / head / "first-view.jpg").is_file(), "the service draws it before it is asked"
        assert page.locator("link[rel=preload]").count() == 2
        assert page.evaluate("tones") == 2
        assert elsewhere.url.endswith(f"/captures?capture={capture}"), "another tab stays"
        page = mine.go("/captures")
        page.locator("#reconstruct").click()
        expect(page).to_have_title(re.compile("% Captures"))
        page.get_by_label("Expression").type("smi")
        message = page.locator(".message", has_text="A head is ready.")
        expect(message).to_be_visible()
        expect(page).to_have_title("Head ready - eigenhead")
        page.keyboard.type("le")  # who has read it, goes on
        expect(page).to_have_title("Captures - eigenhead")
        expect(page.get_by_label("Expression")).to_have_value("smile")
        assert page.evaluate("tones") == 2
        keep_widths(page, screenshots, "head-ready")
        message.get_by_role("link").click()
        page.wait_for_selector("canvas[data-loaded$=head]")
        mine.check_clean()
        other.check_clean()
