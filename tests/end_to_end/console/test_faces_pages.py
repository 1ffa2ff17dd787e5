"""Faces in a real browser: over the pictures, in the verdict, and as suggestions for the feature points."""

import shutil
from pathlib import Path

import httpx
import pytest
from playwright.sync_api import Browser, Page, expect

from pipeline.head_model.landmarks import SEVEN_POINTS
from tests.support.browser import Visit, keep_screenshots, keep_widths, visit
from tests.support.services import RunningService, await_state, packed, running_service, upload
from tests.support.shared_data import shared

pytestmark = [pytest.mark.slow, pytest.mark.timeout(900)]

SLOW_MS = 240_000  # a machine that does other things, too
HIDDEN = "cam04"  # 40 degrees beside the front; what it shows is its clean plate


def uploaded(service: RunningService, folder: Path, name: str, *, hidden: str = "") -> dict:
    """A rendered person's capture; ``hidden``: the camera that shows the empty studio, as noise would show it."""
    target = folder / (name + hidden)
    shutil.copytree(shared("data/captures") / name, target)
    if hidden:
        (plate,) = (target / "background").glob(f"{hidden}.*")
        shutil.copy(plate, target / "images" / plate.name)
        shutil.rmtree(target / "background")  # with it, the verdict says that nobody is there, and nothing of faces
    with httpx.Client(base_url=service.url, timeout=180) as http:
        answer = upload(http, packed(target), label=name + hidden)
    assert answer.status_code == 201, answer.text
    return answer.json()


def test_found_faces_lie_over_pictures(v: Visit, service: RunningService, screenshots: Path, tmp_path: Path) -> None:
    capture = uploaded(service, tmp_path, "beard-smile")
    assert not any(warning["code"].startswith("face-") for warning in capture["warnings"])
    page = v.go(f"/captures?capture={capture['id']}")
    expect(page.locator(".thumb img").first).to_be_visible(timeout=SLOW_MS)
    expect(page.locator("svg.face-marks")).to_have_count(0)
    page.locator("#faces").click()
    expect(page.get_by_text("Looking for faces ...")).to_be_visible()
    marks = page.locator(".thumb svg.face-marks")
    expect(marks.first).to_be_attached(timeout=SLOW_MS)
    assert marks.count() >= 9
    expect(page.locator("#faces-told")).to_contain_text("The face is in")
    box, picture = page.locator(".face-marks rect").first.bounding_box(), page.locator(".thumb").first.bounding_box()
    assert box is not None
    assert picture is not None
    assert 0.15 < box["width"] / picture["width"] < 0.6
    assert picture["x"] < box["x"] < picture["x"] + picture["width"]
    keep_screenshots(page, screenshots, "captures-faces")
    page.locator(".thumb").first.click()
    expect(page.locator(".thumb svg.face-marks")).to_have_count(1)
    keep_screenshots(page, screenshots, "captures-face-large")
    page.keyboard.press("Escape")
    page.locator("#faces").click()
    expect(page.locator("svg.face-marks")).to_have_count(0)


def test_the_verdict_names_faceless_views(v: Visit, service: RunningService, screenshots: Path, tmp_path: Path) -> None:
    capture = uploaded(service, tmp_path, "beard-smile", hidden=HIDDEN)
    page = v.go(f"/captures?capture={capture['id']}")
    expect(page.locator("[data-warning=face-missing]")).to_contain_text(f"was found in {HIDDEN}", timeout=SLOW_MS)
    expect(page.locator("[data-warning^=face-]")).to_have_count(1)
    keep_screenshots(page, screenshots, "captures-face-missing")
    page.locator("button.language").click()  # in German
    expect(page.locator("[data-warning=face-missing]")).to_contain_text(
        f"kein Gesicht in {HIDDEN}, obwohl die Person dorthin blickt", timeout=SLOW_MS
    )


def test_all_points_are_suggested_and_stored_only_when_taken(
    v: Visit, service: RunningService, screenshots: Path, tmp_path: Path
) -> None:
    capture = uploaded(service, tmp_path, "beard-smile")["id"]
    address = f"{service.url}/v1/captures/{capture}/features"
    page = v.go(f"/features/{capture}")
    page.locator("#suggest").click()
    expect(page.locator("#suggestions")).to_contain_text("places are suggested", timeout=SLOW_MS)
    expect(page.locator(".tag.suggested")).to_have_count(len(SEVEN_POINTS))
    expect(page.locator("[data-offer]").first).to_be_attached()
    keep_screenshots(page, screenshots, "features-suggested")
    keep_widths(page, screenshots, "features-suggested")
    reject_take_and_drag(page)
    assert httpx.get(address).json()["points"] == {}
    page.locator("#accept-all").click()
    expect(page.locator("#suggestions")).to_have_count(0)
    expect(page.locator("header .lead")).to_contain_text("7 points in two views or more, not saved")
    assert httpx.get(address).json()["points"] == {}, "taken, and not saved"
    keep_screenshots(page, screenshots, "features-accepted")
    page.locator("#save").click()
    expect(page.get_by_text("Saved.")).to_be_visible(timeout=SLOW_MS)
    points = httpx.get(address).json()["points"]
    assert points.keys() == set(SEVEN_POINTS)
    assert sum(len(views) for views in points.values()) >= 40
    assert 2 <= len(points["exocanthion_right"]) < len(points["pronasale"]), "what was rejected stays out"


def reject_take_and_drag(page: Page) -> None:
    """The first point: rejected in the first view, taken in the second, dragged in the third and taken back there."""
    count = page.locator("[data-offer]").count()
    assert count >= 3
    first = page.locator("svg[data-view]:has([data-offer])").first
    first.focus()
    page.keyboard.press("Delete")
    expect(page.locator("[data-offer]")).to_have_count(count - 1)
    page.locator("[data-accept]").first.click()
    expect(page.locator("[data-point]").first).to_contain_text("1 view")
    expect(page.locator("[data-offer]")).to_have_count(count - 2)
    mark = page.locator("[data-offer]").first.bounding_box()
    assert mark is not None
    x, y = mark["x"] + mark["width"] / 2, mark["y"] + mark["height"] / 2
    page.mouse.move(x, y)
    page.mouse.down()
    page.mouse.move(x + 6, y + 2, steps=4)
    page.mouse.up()
    expect(page.locator("[data-point]").first).to_contain_text("2 views")
    expect(page.locator("[data-offer]")).to_have_count(count - 3)
    page.keyboard.press("Delete")  # a pixel of the screen is three of the picture: it contradicts the other views
    expect(page.locator("[data-point]").first).to_contain_text("1 view")
    expect(page.locator("[data-offer]")).to_have_count(count - 3)


def test_head_is_seen_with_face_that_its_photograph_shows(browser: Browser, screenshots: Path, tmp_path: Path) -> None:
    """The head is a ball; what lies over the photograph is the capture's face."""
    work = "tests.support.ball_results:work"
    with running_service(tmp_path / "data", work=work, console="true") as running:
        capture = uploaded(running, tmp_path, "beard-smile")["id"]
        with httpx.Client(base_url=running.url, timeout=60) as client:
            job = client.post("/v1/jobs", json={"capture_id": capture}).json()["id"]
            await_state(client, job, ("succeeded",))
        v = visit(browser, running.url)
        page = v.go(f"/result/{job}")
        page.wait_for_selector("canvas[data-loaded$=head]", timeout=SLOW_MS)
        page.locator("#through").select_option("cam00")
        expect(page.get_by_alt_text("Photograph of cam00")).to_be_visible(timeout=SLOW_MS)
        expect(page.locator("svg.face-marks")).to_have_count(0)
        page.locator("#faces").check()
        expect(page.locator(".view3d svg.face-marks")).to_have_count(1, timeout=SLOW_MS)
        photograph = page.locator(".view3d img").bounding_box()
        assert page.locator(".view3d svg.face-marks").bounding_box() == photograph
        keep_screenshots(page, screenshots, "result-face")
        page.locator("#through").select_option("")
        expect(page.locator("svg.face-marks")).to_have_count(0)
        v.check_clean()
