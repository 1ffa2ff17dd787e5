"""The whole way in a real browser, from the space bar to the head, on the simulated studio."""

import json
import re
import zipfile
from collections.abc import Callable, Iterator
from pathlib import Path

import httpx
import numpy as np
import pytest
from playwright.sync_api import Browser, Page, expect

from rig.formats.meshes.mesh_file import read_mesh
from tests.support.browser import LONG_MS, keep_screenshots, keep_widths, live_rate, visit
from tests.support.services import RunningService, running_service

pytestmark = [pytest.mark.slow, pytest.mark.timeout(2400)]


@pytest.fixture(scope="module")
def studio(tmp_path_factory: pytest.TempPathFactory) -> Iterator[RunningService]:
    """The real work on the simulated studio."""
    data = tmp_path_factory.mktemp("studio") / "data"
    with running_service(
        data, work="server.tasks.reconstruct:reconstruct_capture", poll_s="0.25", console="true"
    ) as service:
        yield service


@pytest.mark.gl
def test_the_whole_way(
    browser: Browser,
    studio: RunningService,
    screenshots: Path,
    tmp_path: Path,
    record_property: Callable[[str, object], None],
) -> None:
    """From the seat to the files with three keys and clicks; then features picked, and a comparison."""
    v = visit(browser, studio.url)
    page = v.go("/")
    expect(page.locator("article.tile")).to_have_count(11)
    live_rate(page)
    keep_screenshots(page, screenshots, "rig")
    page.keyboard.press("Space")
    expect(page.locator(".countdown")).to_be_visible()
    page.keyboard.press("Escape")
    expect(page.locator(".countdown")).to_have_count(0)
    page.keyboard.press("Space")  # the first of three keys and clicks from the seat to the files
    expect(page.get_by_text("Captured 11 pictures")).to_be_visible(timeout=LONG_MS)
    expect(page.locator("[data-shot]")).to_be_visible()
    keep_widths(page, screenshots, "way-verdict")
    page.keyboard.press("Enter")
    expect(page.locator("#job")).to_be_visible()
    keep_widths(page, screenshots, "way-job")
    running = httpx.get(studio.url + "/v1/jobs").json()["jobs"][0]["state"]
    rate = look_around(browser, studio, screenshots)  # other pages, while the job runs
    record_property("pictures a second of the slowest tile while a job runs", round(rate, 2))
    page.wait_for_url("**/result/*", timeout=LONG_MS)  # the head opens by itself
    page.wait_for_selector("canvas[data-loaded]:not([data-loaded=''])", timeout=LONG_MS)
    keep_widths(page, screenshots, "way-head")
    with page.expect_download() as download:
        page.locator("#all").click()
    download.value.save_as(tmp_path / "all.zip")
    with zipfile.ZipFile(tmp_path / "all.zip") as packed:
        assert {"head.ply", "head.glb", "report.json"} <= set(packed.namelist())
    keep_screenshots(page, screenshots, "result")
    check_viewer(page, screenshots, tmp_path)
    page = v.go("/jobs")
    expect(page.locator("[data-job][data-state=succeeded]")).to_have_count(1, timeout=LONG_MS)
    expect(page.locator("table tbody tr", has_text="cam10").first).to_be_visible()
    keep_screenshots(page, screenshots, "jobs")

    page = v.go("/features")
    pick_features(page, studio, screenshots)
    page.locator("#reconstruct").click()
    expect(page.get_by_text("Queued job")).to_be_visible()
    begun = httpx.get(studio.url + "/v1/jobs").json()["jobs"][0]
    httpx.post(f"{studio.url}/v1/jobs/{begun['id']}/cancel")  # the same again, of silhouettes alone
    wanted = {"capture_id": begun["capture_id"], "settings": {"detail": "span", "outputs": {"surface": "head"}}}
    job = httpx.post(studio.url + "/v1/jobs", json=wanted).json()["id"]
    page = v.go("/jobs")
    expect(page.locator("[data-job][data-state=succeeded]")).to_have_count(2, timeout=LONG_MS)
    report = httpx.get(f"{studio.url}/v1/jobs/{job}/result/report.json").json()
    assert "features.json" in report["inputs"]
    page.locator(f"[data-job='{job}']").click()
    page.locator("#to-result").click()
    page.wait_for_selector("canvas[data-loaded]:not([data-loaded=''])", timeout=LONG_MS)
    compare = page.get_by_label("Compare with")
    compare.select_option(index=2)  # the head of the job before
    expect(page.get_by_text("Distance to the other head")).to_be_visible()
    page = v.go("/calibration")
    expect(page.get_by_role("button", name="Take shot 1")).to_be_enabled()
    keep_screenshots(page, screenshots, "calibration")
    v.check_clean()
    assert running in ("queued", "running")


def look_around(browser: Browser, studio: RunningService, screenshots: Path) -> float:
    """Outlines, the job's page, and the live view, of which the slowest tile's pictures a second are returned."""
    v = visit(browser, studio.url)
    page = v.go("/")
    rate = live_rate(page, 10)
    page = v.go("/jobs")
    keep_screenshots(page, screenshots, "jobs-running")
    page = v.go("/captures")
    expect(page.locator(".thumb img")).to_have_count(11)
    page.get_by_role("button", name="Silhouettes").click()
    outlines = "[...document.querySelectorAll('.thumb img[src*=silhouette]')]"
    page.wait_for_function(f"{outlines}.length === 11 && {outlines}.every(i => i.naturalWidth > 0)", timeout=LONG_MS)
    keep_screenshots(page, screenshots, "captures")
    v.check_clean()
    page.context.close()
    return rate


def check_viewer(page: Page, screenshots: Path, tmp_path: Path) -> None:
    """Uncertainty, truth, measuring, download."""
    page.keyboard.press("u")
    expect(page.locator(".view3d").get_by_text("Standard deviation")).to_be_visible()
    page.screenshot(path=screenshots / "result-uncertainty.png")
    page.get_by_label("Compare with").select_option("truth")
    expect(page.get_by_text("Distance to the truth")).to_be_visible()
    keep_screenshots(page, screenshots, "result-truth")
    page.get_by_label("Compare with").select_option("")
    page.keyboard.press("m")
    box = page.locator("canvas").bounding_box()
    assert box is not None
    for x in (0.46, 0.54):
        page.mouse.click(box["x"] + x * box["width"], box["y"] + 0.45 * box["height"])
    measured = page.get_by_text("mm, straight")
    expect(measured).to_be_visible()
    distance = float((measured.text_content() or "").split()[0])
    assert 5 < distance < 120, "two points of a face"
    page.screenshot(path=screenshots / "result-measure.png")
    page.keyboard.press("m")
    with page.expect_download() as download:
        page.get_by_role("link", name=re.compile(r"^head\.ply")).click()
    download.value.save_as(tmp_path / "head.ply")
    assert len(read_mesh(tmp_path / "head.ply").vertices) > 1000


def pick_features(page: Page, studio: RunningService, screenshots: Path) -> None:
    """Clicks the planted landmarks of the newest capture, by the keyboard and the mouse."""
    capture = httpx.get(studio.url + "/v1/captures").json()["captures"][0]["id"]
    truth = json.loads((studio.data / "captures" / capture / "truth" / "meta.json").read_text())
    page.wait_for_selector("svg[data-view]")
    views = [view.get_attribute("data-view") or "" for view in page.locator("svg[data-view]").all()]
    assert len(views) == 4
    pixels = landmark_pixels(studio, capture, truth)
    for number, name in enumerate(list(pixels)[:4], start=1):
        page.keyboard.press(str(number))
        for camera in views[:3]:
            click_pixel(page, camera, pixels[name][camera])
        expect(page.locator(f"[data-point={name}]")).to_contain_text("3 views")
    page.keyboard.press("5")
    expect(page.locator(f"svg[data-view={views[0]}] polyline")).to_have_count(0)
    expect(page.locator(f"svg[data-view={views[0]}] path[stroke='#f0b95b']")).to_have_count(1)
    page.locator(f"svg[data-view={views[0]}]").focus()
    page.keyboard.press("Enter")  # takes the model's landmark
    fifth = page.locator("[data-point]").nth(4)
    expect(fifth).to_contain_text("1 view")
    expect(page.locator(f"svg[data-view={views[1]}] polyline")).to_have_count(1)
    box = page.locator(f"svg[data-view={views[1]}]").bounding_box()
    assert box is not None
    page.mouse.move(box["x"] + box["width"] / 2, box["y"] + box["height"] / 2)
    keep_screenshots(page, screenshots, "features")
    page.locator(f"svg[data-view={views[0]}]").focus()
    page.keyboard.press("ArrowRight")
    page.keyboard.press("Delete")
    expect(fifth).to_contain_text("not set")
    page.keyboard.press("s")
    expect(page.get_by_text("Saved.")).to_be_visible()
    stored = httpx.get(f"{studio.url}/v1/captures/{capture}/features").json()["points"]
    assert len(stored) == 4
    for name, by_camera in stored.items():
        for camera, at in by_camera.items():  # half a screen pixel is about one of the image here
            assert np.abs(np.array(at) - pixels[name][camera]).max() < 1.5


def landmark_pixels(studio: RunningService, capture: str, truth: dict) -> dict[str, dict[str, np.ndarray]]:
    from pipeline.head_model.landmarks import SEVEN_POINTS
    from rig.formats.cameras.cameras_json import read_rig

    rig = read_rig(studio.data / "captures" / capture / "files" / "cameras.json")
    points = {name: np.array(truth["landmarks_world"][name]) for name in SEVEN_POINTS}
    return {name: {camera.name: camera.project(point[None])[0] for camera in rig} for name, point in points.items()}


def click_pixel(page: Page, camera: str, pixel: np.ndarray) -> None:
    script = """([camera, x, y]) => { const svg = document.querySelector(`svg[data-view=${camera}]`);
      const p = new DOMPoint(x + 0.5, y + 0.5).matrixTransform(svg.getScreenCTM()); return [p.x, p.y]; }"""
    x, y = page.evaluate(script, [camera, float(pixel[0]), float(pixel[1])])
    page.mouse.click(x, y)
