"""The 3D view in a real browser, of balls whose colours and outlines are known."""

import io
from collections.abc import Iterator
from itertools import pairwise
from pathlib import Path

import cv2
import httpx
import numpy as np
import pytest
from PIL import Image
from playwright.sync_api import Browser, Page, Route, expect

from tests.support.ball_results import RADIUS_MM
from tests.support.browser import Visit, keep_screenshots, keep_widths, visit
from tests.support.services import RunningService, await_state, await_true, made_head, running_service

pytestmark = [pytest.mark.slow, pytest.mark.timeout(300)]

# viridis at the nine places between which result.js steps linearly
RAMP = 255 * np.array(
    [[0.267, 0.005, 0.329], [0.283, 0.141, 0.458], [0.254, 0.265, 0.53], [0.207, 0.372, 0.553], [0.164, 0.471, 0.558],
     [0.128, 0.567, 0.551], [0.267, 0.679, 0.48], [0.478, 0.821, 0.318], [0.993, 0.906, 0.144]]
)  # fmt: skip
PARTS = 255 * np.array([[0.9, 0.65, 0.5], [0.35, 0.25, 0.6]])  # skin and hair


@pytest.fixture
def heads(tmp_path: Path) -> Iterator[RunningService]:
    """Two heads of Anna, one of Bert."""
    with running_service(tmp_path / "data", work="tests.support.ball_results:work", console="true") as running:
        client = httpx.Client(base_url=running.url, timeout=60)
        sessions = {n: client.post("/v1/sessions", json={"label": n}).json()["id"] for n in ("Anna", "Bert")}
        for seed, name in enumerate(("Bert", "Anna", "Anna")):
            made_head(client, tmp_path, seed, session=sessions[name])
        yield running


def pixels(page: Page, half: float = 0.16) -> np.ndarray:
    """Of the middle of the 3D view."""
    shown = np.asarray(Image.open(io.BytesIO(page.locator("canvas").screenshot())).convert("RGB"), float)
    height, width = shown.shape[:2]
    reach = round(half * min(height, width))
    return shown[height // 2 - reach : height // 2 + reach, width // 2 - reach : width // 2 + reach]


def off_colours(shown: np.ndarray, colours: np.ndarray) -> np.ndarray:
    """How far each pixel lies from the nearest of ``colours`` (levels)."""
    return np.min(np.linalg.norm(shown.reshape(-1, 1, 3) - colours, axis=2), axis=1)


def off_the_ramp(shown: np.ndarray) -> np.ndarray:
    """How far pixels lie from the legend's colours (levels)."""
    return off_colours(shown, np.concatenate([np.linspace(a, b, 60) for a, b in pairwise(RAMP)]))


def test_the_viewer_shows_the_files(browser: Browser, heads: RunningService, screenshots: Path, tmp_path: Path) -> None:
    v = visit(browser, heads.url)
    page = v.go("/result")
    page.wait_for_selector("canvas[data-loaded$=head]")
    page.keyboard.press("u")
    expect(page.locator(".view3d").get_by_text("Standard deviation")).to_be_visible()
    # 2 of 255 are rounding of the colours and of their interpolation; light would add tens: data are not lit.
    await_true(lambda: off_the_ramp(pixels(page)).max() < 6)
    page.keyboard.press("b")
    page.wait_for_selector("canvas[data-loaded$=bust]")
    page.keyboard.press("p")
    expect(page.get_by_label("Parts")).to_contain_text("hair")
    # edges of 3 mm: a row of triangles between the parts is an eighth of the 40 mm that are looked at, at most
    await_true(lambda: np.mean(off_colours(pixels(page), PARTS) < 3) > 7 / 8)
    keep_screenshots(page, screenshots, "viewer-parts")
    check_comparison(page)
    check_exports(page, tmp_path)
    check_side_by_side(page, screenshots)
    check_look_through(page)
    check_subjects(v, screenshots)
    v.check_clean()


def test_views_from_fixed_sides_fit_the_head(browser: Browser, heads: RunningService, screenshots: Path) -> None:
    """By the lamp at the subject's left: their left side is the brightest, their right one dark, and from the front
    the half at the right of the picture is brighter. The ball keeps off the rims from every side, on either surface."""
    v = visit(browser, heads.url)
    page = v.go("/result")
    page.wait_for_selector("canvas[data-loaded$=head]")
    page.get_by_label("Light").select_option("side")
    page.locator("canvas").focus()
    page.keyboard.press("g")
    level, halves = {}, {}
    for side in ("left", "front", "right", "top", "threequarter"):
        page.locator(f"[data-side={side}]").click()
        expect(page.locator(f"[data-side={side}]")).to_have_attribute("aria-pressed", "true")
        page.wait_for_timeout(500)
        found = pixels(page)
        level[side], halves[side] = found.mean(), found[:, found.shape[1] // 2 :].mean() - found.mean()
        assert_clear_of_rims(page)
    assert level["left"] > level["front"] + 10 > level["right"] + 20
    assert min(halves["front"], halves["top"]) > 5
    page.locator("[data-side=left]").click()
    page.keyboard.press("b")
    page.wait_for_selector("canvas[data-loaded$=bust]")
    await_true(lambda: abs(pixels(page).mean() - level["left"]) < 5)  # the other surface, seen from the same side
    assert_clear_of_rims(page)
    page.keyboard.press("ArrowLeft")  # on a button: the page stays as it is
    page.locator("canvas").focus()
    page.keyboard.press("ArrowLeft")
    expect(page.locator("[data-side=left]")).to_have_attribute("aria-pressed", "false")
    page.keyboard.press("v")
    expect(page.locator("[data-side=front]")).to_have_attribute("aria-pressed", "true")
    page.keyboard.press("f")
    page.wait_for_function("document.fullscreenElement?.matches('.view3d')")
    expect(page.locator("#full")).to_have_attribute("aria-pressed", "true")
    page.keyboard.press("f")
    page.wait_for_function("!document.fullscreenElement")
    keep_widths(page, screenshots, "viewer-sides")
    v.check_clean()


def test_a_picture_of_the_head_stands_where_the_browser_will_draw_it(browser: Browser, heads: RunningService) -> None:
    v = visit(browser, heads.url)
    held: list[Route] = []
    v.page.route("**/head.glb", lambda route: held.append(route))
    page = v.go("/result")
    first = page.locator("#first-view")
    expect(first).to_be_visible()
    page.wait_for_function("document.querySelector('#first-view').naturalWidth === 720")
    before = np.asarray(Image.open(io.BytesIO(page.locator(".view3d").screenshot())).convert("RGB"), float)
    for route in held:
        route.continue_()
    page.wait_for_selector("canvas[data-loaded$=head]")
    expect(first).to_have_count(0)
    after = np.asarray(Image.open(io.BytesIO(page.locator(".view3d").screenshot())).convert("RGB"), float)
    height, width = after.shape[:2]
    middle = np.s_[round(0.1 * height) : round(0.85 * height), width // 2 - height // 2 : width // 2 + height // 2]
    ball = after[middle].max(axis=2) > 60
    assert 0.1 < ball.mean() < 0.9
    assert np.abs(before - after)[middle][ball].mean() < 6, "colours and light"
    assert (ball != (before[middle].max(axis=2) > 60)).mean() < 0.02, "place and size"
    v.check_clean()


def assert_clear_of_rims(page: Page) -> None:
    shown = np.asarray(Image.open(io.BytesIO(page.locator("canvas").screenshot())).convert("L"), float)
    upper = shown[: round(0.9 * len(shown))]  # the row of buttons lies below
    assert (shown > 60).mean() > 0.05, "there is a ball"
    for rim in (upper[3], upper[:, 3], upper[:, -4]):
        assert rim.max() < 60


def test_a_head_and_its_comparison_outlive_a_reload_and_name_its_files(browser: Browser, heads: RunningService) -> None:
    v = visit(browser, heads.url)
    page = v.go("/result")
    page.wait_for_selector("canvas[data-loaded$=head]")
    job = page.url.rpartition("/")[2]
    with page.expect_download() as download:
        page.locator("#all").click()
    assert download.value.suggested_filename == f"head-Anna-{job[-6:]}.zip"
    with page.expect_download() as download:
        page.locator("#picture").click()
    assert download.value.suggested_filename == f"head-Anna-{job[-6:]}.png"
    page.locator("#strangers").check()
    page.get_by_label("Compare with").select_option(index=2)
    expect(page.get_by_text("Distance to a head of ANOTHER SUBJECT")).to_be_visible()
    page.reload()
    expect(page.get_by_text("Distance to a head of ANOTHER SUBJECT")).to_be_visible()
    assert page.url.startswith(f"{heads.url}/result/{job}?other=")
    capture = httpx.get(heads.url + "/v1/captures").json()["captures"][0]["id"]
    made = httpx.post(heads.url + "/v1/jobs", json={"capture_id": capture}).json()["id"]
    with httpx.Client(base_url=heads.url, timeout=60) as http:
        await_state(http, made, ("succeeded",))
    expect(page.get_by_label("Compare with").locator("option")).to_have_count(4)
    expect(page.locator("canvas")).to_have_attribute(
        "data-loaded", f"{job} head"
    )  # a newer one does not take its place
    v.check_clean()


def check_subjects(v: Visit, screenshots: Path) -> None:
    """A card a person with a picture of the newest head, which opens it."""
    page = v.go("/subjects")
    cards = page.locator("[data-subject]")
    expect(cards).to_have_count(2)
    expect(cards.filter(has_text="Anna")).to_contain_text("2 shots · 2 heads")
    page.wait_for_function(
        "[...document.querySelectorAll('.portrait img')].filter(i => i.naturalWidth > 0).length === 2"
    )
    keep_widths(page, screenshots, "subjects")
    page.locator("#find").fill("bert")
    expect(cards).to_have_count(1)
    cards.get_by_role("link", name="Head", exact=True).click()
    expect(page.get_by_label("Head", exact=True).locator("option:checked")).to_contain_text("Bert")


def check_comparison(page: Page) -> None:
    """Only the subject's own head is offered until others are asked for."""
    options = page.get_by_label("Compare with").locator("option")
    expect(options).to_have_count(2)
    expect(options.nth(1)).to_contain_text("Anna")
    page.locator("#strangers").check()
    expect(options).to_have_count(3)
    expect(options.nth(2)).to_contain_text("perhaps another person: Bert")
    page.get_by_label("Compare with").select_option(index=2)
    expect(page.get_by_text("Distance to a head of ANOTHER SUBJECT")).to_be_visible()
    page.get_by_label("Compare with").select_option("")


def check_exports(page: Page, tmp_path: Path) -> None:
    """The picture holds the head, on nothing, and the legend of its colours; the video one turn about the head, under
    a lamp that stands still, so that its bright side changes over."""
    page.locator("canvas").focus()
    page.keyboard.press("u")
    expect(page.locator(".view3d").get_by_text("Standard deviation")).to_be_visible()
    with page.expect_download() as download:
        page.locator("#picture").click()
    picture = np.asarray(Image.open(download.value.path()), float)
    height, width = picture.shape[:2]
    assert picture.shape[2] == 4
    assert picture[-1, 0, 3] == 0
    middle = picture[height // 2 - 40 : height // 2 + 40, width // 2 - 40 : width // 2 + 40]
    assert off_the_ramp(middle[:, :, :3]).max() < 6
    rem, right = height / 40, width - height / 40
    legend = picture[[round(1.1 * rem), round(10.9 * rem)], round(right - rem / 2), :3]
    # A hundredth of the scale from its ends, where its last eighth changes by 131 levels: 10.5, and 2.6 a half pixel.
    assert np.abs(legend - RAMP[[-1, 0]]).max() < 14
    page.locator("canvas").focus()
    page.keyboard.press("g")
    page.get_by_label("Light").select_option("side")
    with page.expect_download() as download:
        page.locator("#turntable").click()
    download.value.save_as(tmp_path / "turn.webm")
    sides = bright_sides(tmp_path / "turn.webm")
    # The lamp stands 80 degrees to the right: straight ahead after 80 degrees of the turn, to the left after 110.
    turned_left = [brighter for second, brighter in sides if 110 < 360 * second / 8 < 170]
    assert sides[0][1] > 5
    assert turned_left
    assert max(turned_left) < -5
    assert 6 < sides[-1][0] < 10, "one turn takes 8 s, however many pictures the machine draws"
    page.get_by_label("Light").select_option("studio")


def bright_sides(video: Path) -> list[tuple[float, float]]:
    """When each picture comes (s), and how much brighter the head's right half is (levels)."""
    capture, found = cv2.VideoCapture(str(video)), []
    while (read := capture.read())[0]:
        height, width = read[1].shape[:2]
        reach = height // 6
        rows = slice(height // 2 - reach, height // 2 + reach)
        left, right = (read[1][rows, width // 2 + a : width // 2 + b] for a, b in ((-reach, 0), (0, reach)))
        found.append((capture.get(cv2.CAP_PROP_POS_MSEC) / 1000, float(right.mean()) - float(left.mean())))
    return found


def check_side_by_side(page: Page, screenshots: Path) -> None:
    """Anna's two heads are equal balls: both halves of the view show the same, however it is turned."""
    page.get_by_label("Compare with").select_option(index=1)
    page.locator("#beside").check()
    expect(page.locator("#right-head")).to_contain_text("Anna")
    page.locator("canvas").focus()
    before = np.zeros(1)
    for keys in (["g"], ["u"], ["ArrowUp"] * 6):
        for key in keys:
            page.keyboard.press(key)
        before = await_halves(page, before)
    keep_widths(page, screenshots, "side-by-side")
    page.locator("#beside").uncheck()
    expect(page.get_by_text("Distance to the other head")).to_be_visible()
    page.get_by_label("Compare with").select_option("")


def await_halves(page: Page, before: np.ndarray, tries: int = 40) -> np.ndarray:
    """The left half of the 3D view, without what is written at its rims, as soon as it is another one than before and
    the right half is the same."""
    for _ in range(tries):
        page.wait_for_timeout(250)
        shown = np.asarray(Image.open(io.BytesIO(page.locator("canvas").screenshot())).convert("RGB"), float)
        height, half = shown.shape[0], shown.shape[1] // 2
        rows, columns = slice(height // 3, 2 * height // 3), slice(half // 5, half - half // 5)
        left, right = shown[rows, :half][:, columns], shown[rows, half : 2 * half][:, columns]
        changed = before.shape != left.shape or np.abs(left - before).max() > 10
        if changed and left.mean() > 40 and np.abs(left - right).max() <= 2:  # levels: ground is 20, rounding 1
            return left
    raise AssertionError("the halves of the view show different balls")


def check_look_through(page: Page) -> None:
    """The ball's outline lies where cam01 sees it: f = 30 px, the centre at (12, 12), 40 mm aside and 1 m away."""
    page.keyboard.press("g")
    page.locator("#through").select_option("cam01")
    expect(page.get_by_alt_text("Photograph of cam01")).to_be_visible()
    page.get_by_label("How much of the photograph").fill("0")
    page.wait_for_function("document.querySelector('.view3d img').naturalWidth === 24")
    page.evaluate("document.querySelector('.view3d img').style.visibility = 'hidden'")
    page.wait_for_timeout(500)
    shown = np.asarray(Image.open(io.BytesIO(page.locator("canvas").screenshot())).convert("RGB"), float)
    height, width = shown.shape[:2]
    scale = min(width, height) / 24
    ball = shown[:, :, 0] > 60  # clay on a dark ground
    rows, columns = np.nonzero(ball)
    radius = 30 * RADIUS_MM / np.sqrt(1000**2 - RADIUS_MM**2) * scale
    left, top = (width - 24 * scale) / 2, (height - 24 * scale) / 2
    middle = np.array([left + scale * (12 + 30 * 0.04 + 0.5), top + scale * 12.5])
    box = np.array([[columns.min(), rows.min()], [columns.max() + 1, rows.max() + 1]])
    # a pixel of the screen at each side; off the axis by 1.2 of 30 px a ball's outline is an ellipse longer by 0.1 %
    np.testing.assert_allclose(box.mean(axis=0), middle, atol=1.5)
    np.testing.assert_allclose((box[1] - box[0]) / 2, radius, atol=1.5)
