"""What holds on every page: it can be read and used, needs a key where one is set, and outlives its service."""

from pathlib import Path

import httpx
import pytest
from playwright.sync_api import Browser, Page, ViewportSize, expect

from tests.support.attacks import add_keys
from tests.support.browser import keep_screenshots, violations, visit
from tests.support.services import RunningService, await_state, uploaded_capture

pytestmark = [pytest.mark.slow, pytest.mark.timeout(900)]

TELEPHONE, DESK = ViewportSize(width=360, height=740), ViewportSize(width=1366, height=768)
# What lies beside the window and cannot be scrolled to, and controls that do not answer at their middle once they are
# scrolled to. The page that says how narrow the window is measures in whole pixels, so that one is let pass.
UNREACHABLE = """() => {
  const found = [];
  const says = (e) => `${e.tagName} ${e.id || e.getAttribute("aria-label") || e.textContent.trim().slice(0, 30)}`;
  const over = (e, kinds) => kinds.test(getComputedStyle(e).overflowX);
  const scrolls = (e) => e && (over(e, /auto|scroll/) && e.scrollWidth > e.clientWidth || scrolls(e.parentElement));
  const clipped = (e) => e && (over(e, /hidden|clip/) && e !== document.body || clipped(e.parentElement));
  const shown = (e) => e.checkVisibility({ visibilityProperty: true }) && e.getBoundingClientRect().width > 1;
  const outside = ({ left, right }) => left < -1 || right > innerWidth + 1;
  const span = ({ left, right }) => `from ${Math.round(left)} to ${Math.round(right)} px`;
  for (const e of document.querySelectorAll("section.page *, nav *, aside *")) {
    const box = e.getBoundingClientRect();
    if (shown(e) && outside(box) && !scrolls(e.parentElement) && !clipped(e.parentElement))
      found.push(`${says(e)} reaches ${span(box)}`);
  }
  for (const e of document.querySelectorAll("a, button, input, select, textarea, [tabindex='0']")) {
    if (!shown(e) || e.disabled) continue;
    e.scrollIntoView({ block: "center", inline: "center", behavior: "instant" });
    const box = e.getBoundingClientRect();
    const x = (Math.max(0, box.left) + Math.min(innerWidth, box.right)) / 2;
    const y = (Math.max(0, box.top) + Math.min(innerHeight, box.bottom)) / 2;
    const at = document.elementFromPoint(x, y);
    if (!at || !(e.contains(at) || at.contains(e) && !at.matches("body, html")))
      found.push(`${says(e)} is covered by ${at ? says(at) : "nothing"}`);
    else if (e.matches("button, select, input") && outside(box)) found.push(`${says(e)} is cut: ${span(box)}`);
  }
  document.querySelector("nav [aria-current]")?.scrollIntoView({ inline: "center" });
  return found;
}"""


def fill(service: RunningService, folder: Path, person: str = "") -> None:
    """Gives every page something to show: a capture (of a session with tags, if a ``person`` is named), its head, and
    jobs and batches that fail."""
    capture = uploaded_capture(service, folder)
    with httpx.Client(base_url=service.url, timeout=60) as http:
        if person:
            session = http.post("/v1/sessions", json={"label": person}).json()["id"]
            http.patch(f"/v1/captures/{capture}", json={"session": session, "tags": ["glasses", "study 4"]})
        for settings in ({}, {"front": "fail"}):
            job = http.post("/v1/jobs", json={"capture_id": capture, "settings": settings}).json()["id"]
            await_state(http, job, ("succeeded", "failed"))
            http.post("/v1/batches", json={"captures": [capture], "settings": settings})


def test_every_page_is_accessible(browser: Browser, service: RunningService, screenshots: Path, tmp_path: Path) -> None:
    """On a telephone, and dark and light at a desk: axe-core finds nothing, and each page says what to do."""
    v, found = visit(browser, service.url), []
    screenshots.mkdir(parents=True, exist_ok=True)
    v.page.set_viewport_size(TELEPHONE)
    for name, page in v.walk(lambda: fill(service, tmp_path, "Anna with a name that is as long as names may well be")):
        found += [f"{name}, narrow: {fault}" for fault in narrow_faults(page, screenshots / f"narrow-{name}.png")]
        page.set_viewport_size(DESK)
        if name == "empty":
            page.keyboard.press("?")
            expect(page.get_by_role("dialog")).to_be_visible()
            found += [f"keys: {violation}" for violation in violations(page)]
            page.keyboard.press("Escape")
        if name.startswith("empty"):
            keep_screenshots(page, screenshots, name)
        else:
            found += [f"{name}: {violation}" for violation in violations(page)]
            page.locator("#look").click()
            expect(page.locator("body")).to_have_css("background-color", "rgb(242, 244, 247)")
            found += [f"{name}, light: {violation}" for violation in violations(page)]
            page.screenshot(path=screenshots / f"light-{name}.png")
            page.locator("#look").click()
        page.set_viewport_size(TELEPHONE)
    assert found == []
    # The browser notes that the head of this service's stand-in for a job has no portrait.
    v.errors = [error for error in v.errors if "422" not in error]
    v.check_clean()


def narrow_faults(page: Page, picture: Path) -> list[str]:
    """What cannot be read or reached on a telephone."""
    page.screenshot(path=picture)
    assert page.evaluate("document.documentElement.scrollWidth") == TELEPHONE["width"], picture
    assert "'errors'" not in page.inner_text("body"), "nobody sends a document from a page"
    active = page.locator("nav [aria-current]").bounding_box()
    assert active is not None
    hidden = active["x"] < 0 or active["x"] + active["width"] > TELEPHONE["width"] + 1
    found = ["the bar of pages does not show where one is"] * hidden
    return [*found, *page.evaluate(UNREACHABLE), *violations(page)]


def test_a_page_comes_back_after_a_kill(browser: Browser, service: RunningService, tmp_path: Path) -> None:
    uploaded_capture(service, tmp_path, 1)
    v = visit(browser, service.url)
    page = v.go("/captures")
    expect(page.locator(".row-button")).to_have_count(1)  # sent with the page
    expect(page.get_by_text("GB free")).to_be_visible()  # over the socket, which is there now
    service.kill()
    expect(page.locator("#popup")).to_be_visible()
    expect(page.locator(".rail .foot .line").first).to_have_text("Connection lost.")  # and not Ready beside it
    service.start()
    uploaded_capture(service, tmp_path, 2)
    expect(page.locator(".row-button")).to_have_count(2)
    expect(page.locator("#popup")).to_be_hidden()
    page.locator("#reconstruct").click()  # and it works again
    expect(page.get_by_text("Queued job")).to_be_visible()


def test_a_key_is_asked_for_and_stays_out_of_every_address(
    browser: Browser, service: RunningService, tmp_path: Path, screenshots: Path
) -> None:
    uploaded_capture(service, tmp_path)
    (made,) = add_keys(service, "read")
    v = visit(browser, service.url)
    v.page.goto(service.url + "/jobs")
    expect(v.page.get_by_label("API key")).to_be_visible()
    assert v.page.url.endswith("/sign-in")
    keep_screenshots(v.page, screenshots, "sign-in")
    for path in ("/console/live", "/console/captures/x/cam00.jpg"):
        assert httpx.get(service.url + path).status_code == 401
    v.page.get_by_label("API key").fill("eh_0123456789ab_wrong")
    v.page.keyboard.press("Enter")
    expect(v.page.get_by_text("No such key")).to_be_visible()
    v.page.get_by_label("API key").fill(made)
    v.page.keyboard.press("Enter")
    expect(v.page.locator("article.tile")).to_have_count(11)
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
    expect(v.page.locator(".thumb img").first).to_be_visible()


def test_other_web_pages_reach_nothing(service: RunningService) -> None:
    foreign = {"origin": "http://evil.example"}
    assert httpx.get(service.url + "/", headers=foreign).status_code == 403
    assert httpx.get(service.url + "/console/live", headers={"host": "evil.example"}).status_code == 403
    socket = "/_nicegui_ws/socket.io/?EIO=4&transport=polling"
    assert httpx.get(service.url + socket, headers=foreign).status_code == 403
    missing = httpx.get(service.url + "/v1/nothing")
    assert missing.headers["content-type"] == "application/problem+json"
    assert httpx.put(service.url + "/v1/captures").status_code == 405
