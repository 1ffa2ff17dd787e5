"""Features, jobs and calibrations in a real browser."""

import re
import shutil
from pathlib import Path

import httpx
import pytest
from playwright.sync_api import Browser, Page, expect

from rig.formats.captures.archive import pack_folder
from tests.support.browser import LONG_MS, Visit, keep_screenshots, keep_widths, live_rate, visit
from tests.support.services import RunningService, uploaded_capture
from tests.support.shared_data import shared

pytestmark = [pytest.mark.slow, pytest.mark.timeout(900)]


def test_quick_keys_do_not_overtake_each_other(v: Visit, service: RunningService, tmp_path: Path) -> None:
    uploaded_capture(service, tmp_path)
    page = v.go("/features")
    view = page.locator("svg[data-view]").first
    view.focus()
    for _ in range(4):
        page.keyboard.press("Enter")  # nothing is suggested: the middle of the image, 12, 12
        for _ in range(8):
            page.keyboard.press("ArrowRight")
        expect(page.get_by_text("14.0, 12.0")).to_be_visible()
        expect(page.locator("[data-point]").first).to_contain_text("1 view")
        page.keyboard.press("ArrowLeft")
        page.keyboard.press("Delete")
        expect(page.locator("[data-point]").first).to_contain_text("not set")


def test_points_that_contradict_are_told_before_they_are_saved(
    v: Visit, service: RunningService, screenshots: Path, tmp_path: Path
) -> None:
    """The cameras stand side by side: a point lies in the same row of all pictures."""
    capture = uploaded_capture(service, tmp_path)
    page = v.go(f"/features/{capture}")
    for number, up in enumerate((0, 3)):  # a reload may lose the last keys: 2, 4 and 6 px contradict, 8 px do not
        page.locator("svg[data-view]").nth(number).focus()
        page.keyboard.press("Enter")
        for _ in range(up):
            page.keyboard.press("Shift+ArrowUp")
    first = page.locator("[data-point]").first
    expect(first).to_contain_text("contradicts")
    page.reload()
    expect(first).to_contain_text("2 views")  # not saved, and still there
    page.locator("#save").click()
    dialog = page.locator("#contradictions")
    expect(dialog).to_contain_text("views contradict each other")
    keep_widths(page, screenshots, "features-contradiction")
    stored = f"{service.url}/v1/captures/{capture}/features"
    assert httpx.get(stored).json()["points"] == {}
    page.locator("#save-anyway").click()
    expect(page.get_by_text("Saved.")).to_be_visible()
    expect(dialog).to_have_count(0)
    assert len(httpx.get(stored).json()["points"]["exocanthion_right"]) == 2


def test_a_job_is_cancelled_and_begun_with_other_settings(v: Visit, service: RunningService, tmp_path: Path) -> None:
    capture = uploaded_capture(service, tmp_path)
    httpx.post(service.url + "/v1/jobs", json={"capture_id": capture, "settings": {"front": "long"}})
    page = v.go("/jobs")
    expect(page.locator("[data-state=running]")).to_have_count(1)
    expect(page.get_by_text(re.compile(r"\d s left")).first).to_be_visible()
    page.locator("#cancel").click()
    expect(page.locator("[data-state=cancelled]")).to_have_count(1)
    page.locator("#restart").click()
    page.get_by_label("Front camera").fill("fail")
    page.get_by_label("Further settings").fill("{")
    page.reload()
    expect(page.get_by_label("Front camera")).to_have_value("fail")  # what was typed outlives a reload
    page.get_by_role("button", name="Queue the new job").click()
    expect(page.get_by_text("the text is no JSON")).to_be_visible()
    expect(page.get_by_label("Front camera")).to_have_value("fail")  # a refused form keeps what was typed
    page.get_by_label("Further settings").fill("")
    page.get_by_role("button", name="Queue the new job").click()
    expect(page.locator("[data-state=failed]")).to_have_count(1)
    expect(page.get_by_text("cam01 sees nobody")).to_be_visible()
    newest = httpx.get(service.url + "/v1/jobs").json()["jobs"][0]
    assert newest["settings"] == {"front": "fail"}
    assert newest["restart_of"] is not None
    check_list(page, service, capture)


def check_list(page: Page, service: RunningService, capture: str) -> None:
    """The running job lies on top, whatever came after it; the queue follows in its order."""
    jobs = service.url + "/v1/jobs"
    running = httpx.post(jobs, json={"capture_id": capture, "settings": {"front": "long"}}).json()["id"]
    expect(page.locator(f"[data-job='{running}'][data-state=running]")).to_have_count(1)
    queued = [
        httpx.post(jobs, json={"capture_id": capture, "priority": priority}).json()["id"] for priority in (100, 50)
    ]
    expect(page.locator("[data-job]")).to_have_count(5)
    listed = [row.get_attribute("data-job") for row in page.locator("[data-job]").all()]
    assert listed[:3] == [running, *reversed(queued)], "then the queue in its order"
    page.locator(f"[data-job='{queued[0]}']").click()
    expect(page.get_by_text("Waiting, 2 jobs before it")).to_be_visible()
    for job in (*queued, running):
        httpx.post(f"{jobs}/{job}/cancel")


def test_pages_show_the_truth_after_the_service_was_killed_under_a_job(
    browser: Browser, service: RunningService, tmp_path: Path
) -> None:
    """What they showed before was made wrong meanwhile: the job that ran is cancelled, another one is done."""
    capture = uploaded_capture(service, tmp_path)
    httpx.post(service.url + "/v1/jobs", json={"capture_id": capture, "settings": {"front": "long"}})
    page, rig = visit(browser, service.url).go("/jobs"), visit(browser, service.url).go("/")
    expect(page.locator("[data-state=running]")).to_have_count(1)
    live_rate(rig)
    service.kill()
    for shown in (page, rig):
        expect(shown.locator("#popup")).to_be_visible()
    service.start()
    job = httpx.get(service.url + "/v1/jobs").json()["jobs"][0]["id"]
    assert httpx.post(f"{service.url}/v1/jobs/{job}/cancel").status_code < 300
    assert httpx.post(service.url + "/v1/jobs", json={"capture_id": capture}).status_code == 202
    expect(page.locator("[data-state=cancelled]")).to_have_count(1, timeout=150_000)
    expect(page.locator("[data-state=succeeded]")).to_have_count(1)
    expect(page.locator("#popup")).to_be_hidden()
    expect(rig.locator("#popup")).to_be_hidden()
    tile = rig.locator("article.tile").first
    for _ in range(2):  # pictures again: the page begins to count anew, once
        expect(tile).not_to_have_attribute("data-frames", tile.get_attribute("data-frames") or "")


def test_a_calibration_is_uploaded_shown_and_refused_for_another_rig(
    v: Visit, service: RunningService, screenshots: Path, tmp_path: Path
) -> None:
    board, folder = shared("data/multicam-board"), tmp_path / "board"
    for camera in ("cam_0", "cam_1", "cam_2", "cam_3"):
        shutil.copytree(board / camera, folder / "IMAGES" / camera)
    shutil.copy(board / "board.toml", folder / "board.toml")
    pack_folder(folder, tmp_path / "board.tar")
    page = v.go("/calibration")
    page.locator("input[type=file]").set_input_files([tmp_path / "board.tar"])
    row = page.locator("[data-calibration]")
    expect(row).to_have_count(1, timeout=LONG_MS)
    expect(page.locator("[data-calibration][data-state=succeeded]")).to_have_count(1, timeout=LONG_MS)
    expect(page.locator("table tr", has_text="cam_3")).to_be_visible()
    verdict = page.locator("#calibration-verdict")
    expect(verdict).to_have_attribute("data-verdict", "usable")
    expect(verdict).to_contain_text("focal length is uncertain by more than 1 %")
    keep_screenshots(page, screenshots, "calibration-report")
    (made,) = httpx.get(service.url + "/v1/calibrations").json()["calibrations"]
    address = f"{service.url}/v1/calibrations/{made['id']}"
    assert made["figures"]["rms_px"] <= 1.1
    cameras = httpx.get(address + "/cameras.json").json()["cameras"]
    assert [camera["name"] for camera in cameras] == [path.name for path in sorted((folder / "IMAGES").iterdir())]
    assert "<html" in httpx.get(address + "/report.html").text[:2000].lower()
    page.get_by_role("button", name="Use this").click()
    expect(page.get_by_text("The calibration is of other cameras than the rig has")).to_be_visible()
    page.get_by_role("button", name="New calibration").click()
    page.locator("#shoot").click()  # the studio has a person in it, and no board
    expect(page.get_by_text("No camera saw the board")).to_be_visible(timeout=LONG_MS)
    assert httpx.get(service.url + "/v1/captures").json()["captures"] == []
