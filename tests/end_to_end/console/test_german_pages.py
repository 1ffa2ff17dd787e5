"""The pages in German, and that no word of theirs escapes the table.

What of the table is missing or unused is told without a browser in ``tests/server/console/test_language.py``.
"""

from pathlib import Path

import httpx
import pytest
from playwright.sync_api import Browser, Page, expect

from tests.end_to_end.console.test_every_page import fill
from tests.support.browser import Visit, violations, visit
from tests.support.services import RunningService, made_head, running_service

pytestmark = [pytest.mark.slow, pytest.mark.timeout(900)]

STATIC = Path(__file__).parents[3] / "server" / "console" / "static"
# A table in which every text is its own translation, in brackets: what stands outside of brackets was never said.
BRACKETS = """export default new Proxy({}, {
  get: (_, text) => typeof text === "string" ? text.split(" | ").map((form) => `⟦${form}⟧`).join(" | ") : undefined,
  ownKeys: () => [],
});"""
# What the service tells: German in brackets, by its code.
TOLD = (
    (STATIC / "messages_de.js").read_text(encoding="utf-8").replace("export default", "const german =")
    + """
const brackets = (text) => text.split(" | ").map((form) => `⟦${form}⟧`).join(" | ");
export default Object.fromEntries(Object.entries(german).map(([code, text]) => [code, brackets(text)]));
"""
)
SCRIPT = "text/javascript"
SHOWN = """() => {
  const seen = [], walker = document.createTreeWalker(document.body, NodeFilter.SHOW_TEXT);
  const silent = "script, style, kbd, .mono, #esm-fallback, #starting, button[lang]";
  while (walker.nextNode())
    if (!walker.currentNode.parentElement.closest(silent)) seen.push(walker.currentNode.textContent);
  for (const name of ["aria-label", "title", "placeholder", "alt"])
    for (const at of document.querySelectorAll(`[${name}]`)) seen.push(at.getAttribute(name));
  return seen.map((text) => text.trim()).filter(Boolean);
}"""
# Of what is shown: names of cameras, people and files, times, numbers with units, and names that are typed elsewhere.
NAMES = (
    r"cam\d+|eigenhead|EIGENHEAD_\w+|\w+\.(json|zip|glb|ply|obj|png|html)\b|subject \d|\b[0-9a-f]{6}\b"
    r"|\b(px|mm|GB|MB|kB|min|IoU|cpu|Nov|Dec)\b"
)
# Whatever reaches beyond the window, unless it lies in something that scrolls; and what its words do not fit.
OUTSIDE = """() => {
  const scrolls = (at) => at && (/auto|scroll/.test(getComputedStyle(at).overflowX) || scrolls(at.parentElement));
  const worded = "button, a.b, .tag, th, h1, h2:not(.cut), h3, .grow:not(.cut, .bar, .scroll, input, select)";
  const found = [], tell = (what, at) => found.push(`${what}: ${at.outerHTML.slice(0, 120)}`);
  for (const at of document.querySelectorAll(".page *")) {
    const box = at.getBoundingClientRect();
    if (!box.width || !box.height || at.closest(".unseen, svg, canvas")) continue;
    if (box.right > innerWidth + 1 && !scrolls(at.parentElement)) tell("beyond the window", at);
    if (at.matches(worded) && at.clientWidth && at.scrollWidth > at.clientWidth + 1) tell("does not fit", at);
  }
  return found;
}"""


def german(browser: Browser, service: RunningService) -> Visit:
    context = browser.new_context(viewport={"width": 1366, "height": 768}, locale="de-DE")
    return Visit(context.new_page(), service.url)


def misfits(page: Page, folder: Path, name: str) -> list[str]:
    """At a desk's, a tablet's and a telephone's width: what does not fit, and what axe-core finds."""
    found = []
    for width, height in ((1366, 768), (1024, 768), (390, 844)):
        page.set_viewport_size({"width": width, "height": height})
        page.wait_for_timeout(400)
        page.screenshot(path=folder / f"{name}-{width}.png")
        found += [f"{name} at {width}: {misfit}" for misfit in (*page.evaluate(OUTSIDE), *violations(page))]
    page.set_viewport_size({"width": 1366, "height": 768})
    return found


def test_pages_fit_in_german(browser: Browser, service: RunningService, screenshots: Path, tmp_path: Path) -> None:
    v, found = german(browser, service), []
    for name, page in v.walk(lambda: fill(service, tmp_path)):
        assert page.evaluate("document.documentElement.lang") == "de"
        found += misfits(page, screenshots, f"german-{name}")
    assert found == []
    v.errors = [error for error in v.errors if "422" not in error]  # a stand-in for a head has no portrait
    v.check_clean()


def test_a_persons_heads_fit_in_german(browser: Browser, screenshots: Path, tmp_path: Path) -> None:
    with running_service(tmp_path / "data", work="tests.support.ball_results:work", console="true") as running:
        client = httpx.Client(base_url=running.url, timeout=60)
        session = client.post("/v1/sessions", json={"label": "Anna"}).json()["id"]
        for seed in range(2):
            made_head(client, tmp_path, seed, session=session)
        v = german(browser, running)
        page = v.go("/result")
        page.wait_for_selector("canvas[data-loaded$=head]")
        page.keyboard.press("u")
        expect(page.locator(".view3d").get_by_text("Standardabweichung")).to_be_visible()
        found = misfits(page, screenshots, "german-head")
        page.get_by_label("Vergleichen mit").select_option(index=1)
        expect(page.get_by_text("Abstand zum anderen Kopf")).to_be_visible()
        page.get_by_label("nebeneinander").check()
        expect(page.locator("#left-head")).to_contain_text("Anna")
        found += misfits(page, screenshots, "german-two-heads")
        page = v.go("/result")
        page.wait_for_selector("canvas[data-loaded$=head]")
        page.keyboard.press("b")
        page.wait_for_selector("canvas[data-loaded$=bust]")
        page.keyboard.press("p")
        expect(page.get_by_label("Teile")).to_contain_text("Haar")
        page = v.go("/subjects")
        page.wait_for_timeout(1500)
        found += misfits(page, screenshots, "german-anna")
        assert found == []
        v.check_clean()


def test_pages_and_what_the_service_tells_are_in_the_browsers_language_until_one_is_chosen(
    browser: Browser, service: RunningService, tmp_path: Path
) -> None:
    v = german(browser, service)
    page = v.go("/captures")
    expect(page.get_by_role("heading", name="Aufnahmen", level=1)).to_be_visible()
    expect(page).to_have_title("Aufnahmen - eigenhead")
    page.get_by_role("button", name="English").click()
    expect(page.get_by_role("heading", name="Captures", level=1)).to_be_visible()
    assert page.evaluate("document.documentElement.lang") == "en"
    v.go("/jobs")
    expect(page.get_by_role("heading", name="Jobs", level=1)).to_be_visible()  # it is kept
    page.get_by_role("button", name="Deutsch").click()
    expect(page.get_by_role("heading", name="Aufträge", level=1)).to_be_visible()
    english = visit(browser, service.url).go("/captures")
    expect(english.get_by_role("heading", name="Captures", level=1)).to_be_visible()
    assert english.evaluate("document.documentElement.lang") == "en"

    fill(service, tmp_path)
    v.go("/captures")
    page.locator("#reconstruct").click()
    expect(page.get_by_text("ist eingereiht. Zu verfolgen auf der Seite Aufträge.")).to_be_visible()
    expect(page.get_by_text("GB frei")).to_be_visible()
    v.check_clean()


def test_no_word_of_a_page_escapes_the_table(browser: Browser, service: RunningService, tmp_path: Path) -> None:
    v, escaped, said = german(browser, service), [], 0
    v.page.route("**/console/static/de.js", lambda route: route.fulfill(body=BRACKETS, content_type=SCRIPT))
    v.page.route("**/console/static/messages_de.js", lambda route: route.fulfill(body=TOLD, content_type=SCRIPT))
    for name, page in v.walk(lambda: fill(service, tmp_path)):
        page.keyboard.press("?")
        expect(page.get_by_role("dialog")).to_be_visible()
        texts = page.evaluate(SHOWN)
        said += sum("⟦" in text for text in texts)
        escaped += [f"{name}: {text}" for text in unsaid(page, texts)]
    assert sorted(set(escaped)) == []
    assert said > 1000  # of sixteen pages


def unsaid(page: Page, texts: list[str]) -> list[str]:
    """Those with words outside of brackets."""
    strip = """([texts, names]) => texts.filter((text) => {
      let rest = text, before;
      do { before = rest; rest = rest.replace(/⟦[^⟦⟧]*⟧/g, " "); } while (rest !== before);
      return /[A-Za-z]{3,}/.test(rest.replace(new RegExp(names, "g"), " "));
    })"""
    return page.evaluate(strip, [texts, NAMES])
