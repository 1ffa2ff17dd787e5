"""How long an operator waits at the console's pages, in Chromium, in seconds.

python -m tests.laboratory console_timings --keep FOLDER --rounds 5

- ``head``, ``bust``: from asking for a result's page to the first picture of its head; from the key B to the bust's;
- ``done_to_picture``: from the end of a job, as the worker dates it, to the picture of its head that the service draws,
  where the head opens; ``done_to_head``: to the browser's own, which can be turned;
- ``click``: on the page of features, from a click to the residual that follows from it, with 26 points in 11 views.

A service is started with a sample capture of the simulated studio, whose head the first round makes with the default
settings. ``--keep`` makes it once in FOLDER and uses it again. [median, slowest] of the rounds; the first visit, which
fills the browser's cache as an operator's first one of the day does, stands by itself as ``head_first_visit``. Figures
hold for a machine that does nothing else: ``load`` is its mean over the last one and five minutes.
"""

import json
import os
import statistics
import time
from contextlib import ExitStack
from datetime import datetime
from pathlib import Path
from typing import Any

import httpx
import numpy as np
from playwright.sync_api import Page

from rig.formats.cameras.cameras_json import read_rig
from tests.support.browser import LONG_MS, Visit, chromium, visit
from tests.support.services import RunningService, await_state, running_service

JOB_S = 900.0

# When (s since 1970) each surface of each job, and the service's picture, was first drawn: after the frame that did.
WATCH = """window.drawn = {}; (function look() {
  const still = document.querySelector('#first-view');
  for (const name of [document.querySelector('canvas[data-loaded]')?.dataset.loaded, still?.naturalWidth && 'picture'])
    if (name && !(name in drawn)) { drawn[name] = null; requestAnimationFrame(() => requestAnimationFrame(() => {
      drawn[name] = (performance.timeOrigin + performance.now()) / 1000; })); }
  requestAnimationFrame(look); })();"""

# From the pointer's release to the frame after the list's residual has changed, in seconds.
CLICK = """(name) => new Promise((done, fail) => {
  const told = () => document.querySelector(`[data-point=${name}] .num`)?.textContent, before = told();
  let began = 0;
  window.addEventListener('pointerup', (event) => { began = event.timeStamp; }, { once: true, capture: true });
  const late = setTimeout(() => fail(new Error('nothing changed')), 20000);
  (function look() {
    if (began && told() !== before) { clearTimeout(late); done((performance.now() - began) / 1000); }
    else requestAnimationFrame(look); })(); })"""


def sample(client: httpx.Client) -> str:
    """A capture of the studio; the newest one where there is one already."""
    known = client.get("/v1/captures").json()["captures"]
    return known[0]["id"] if known else client.post("/v1/captures", json={"seed": 11}).json()["id"]


def first_head(client: httpx.Client, capture: str) -> str:
    """The newest finished job of a capture, made where there is none."""
    done = client.get("/v1/jobs", params={"capture": capture, "state": "succeeded"}).json()["jobs"]
    if done:
        return done[0]["id"]
    job = client.post("/v1/jobs", json={"capture_id": capture}).json()["id"]
    return await_state(client, job, ("succeeded",), JOB_S)["id"]


def drawn(page: Page, name: str) -> float:
    """When a surface was first drawn (s since 1970)."""
    page.wait_for_function("(name) => window.drawn[name]", arg=name, timeout=LONG_MS)
    return page.evaluate("(name) => window.drawn[name]", name)


def time_viewer(v: Visit, job: str, rounds: int) -> dict[str, list[float]]:
    head, bust = [], []
    for _ in range(rounds + 1):
        began = time.time()
        page = v.go(f"/result/{job}")
        head.append(drawn(page, f"{job} head") - began)
        page.wait_for_timeout(500)
        began = time.time()
        page.keyboard.press("b")
        bust.append(drawn(page, f"{job} bust") - began)
    return {"head_first_visit": head[:1], "head": head[1:], "bust": bust[1:]}


def ended_at(service: RunningService, job: str) -> float:
    """When the worker wrote that a job is finished (s since 1970): in SQLite the engine keeps whole seconds."""
    line = next(line for line in service.log.read_text().splitlines() if "job finished" in line and job in line)
    return datetime.fromisoformat(line.split()[0]).timestamp()


def time_opening(
    v: Visit, service: RunningService, client: httpx.Client, capture: str, rounds: int
) -> dict[str, list[float]]:
    """Jobs of a quick method, since only their end counts; they are begun on the page, and removed."""
    picture, head = [], []
    for _ in range(rounds):
        page = v.go(f"/captures?capture={capture}")
        page.locator("#method").select_option("quick")
        page.locator("#reconstruct").click()
        page.wait_for_url("**/result/*", timeout=JOB_S * 1000)
        job = page.url.rpartition("/")[2]
        seen, ended = drawn(page, f"{job} head"), ended_at(service, job)
        head.append(seen - ended)
        picture.append(drawn(page, "picture") - ended)
        client.delete(f"/v1/jobs/{job}")
    return {"done_to_picture": picture, "done_to_head": head}


def time_clicks(v: Visit, service: RunningService, client: httpx.Client, capture: str, rounds: int) -> Any:
    """All landmarks of the simulated subject stand in all views where they lie; the first one is clicked elsewhere."""
    folder = service.data / "captures" / capture
    rig = read_rig(folder / "files" / "cameras.json")
    truth = json.loads((folder / "truth" / "meta.json").read_text())["landmarks_world"]
    points = {
        name: {camera.name: camera.project(np.array(place)[None])[0].tolist() for camera in rig}
        for name, place in truth.items()
    }
    client.put(f"/v1/captures/{capture}/features", json={"points": points}).raise_for_status()
    page = v.go(f"/features/{capture}")
    page.wait_for_selector("svg[data-view]")
    page.wait_for_timeout(3000)  # the model's landmarks are asked for once a service
    box = page.locator("svg[data-view]").first.bounding_box()
    assert box is not None
    took = []
    for number in range(3 * rounds):
        waiting = page.evaluate_handle(f"() => {{ window.took = ({CLICK})('exocanthion_right'); }}")
        page.mouse.click(box["x"] + box["width"] * (0.4 + 0.01 * number), box["y"] + box["height"] * 0.45)
        took.append(page.evaluate("() => window.took"))
        waiting.dispose()
        page.wait_for_timeout(300)
    return {"click": took, "points": len(points), "views": len(rig.names)}


def run(scratch: Path, *, keep: Path | None = None, rounds: int = 5) -> dict[str, Any]:
    """Returns the figures of this module."""
    with ExitStack() as stack:
        folder = keep or scratch
        folder.mkdir(exist_ok=True)
        work = "server.tasks.reconstruct:reconstruct_capture"
        service = stack.enter_context(running_service(folder / "data", work=work, poll_s="0.25", console="true"))
        client = stack.enter_context(httpx.Client(base_url=service.url, timeout=120))
        capture = sample(client)
        job = first_head(client, capture)
        v = visit(stack.enter_context(chromium()), service.url)
        v.page.add_init_script(WATCH)
        figures: dict[str, Any] = time_viewer(v, job, rounds)
        figures |= time_clicks(v, service, client, capture, rounds)
        figures |= time_opening(v, service, client, capture, rounds)
        bytes_of = {
            n: f["bytes"] for n, f in client.get(f"/v1/jobs/{job}").json()["files"].items() if n.endswith("glb")
        }
        v.check_clean()
    timings = {
        name: [round(statistics.median(took), 3), round(max(took), 3)] if isinstance(took, list) else took
        for name, took in figures.items()
    }
    machine = {"cores": len(os.sched_getaffinity(0)), "load": [round(load, 1) for load in os.getloadavg()[:2]]}
    return {"figures": {"s [median, slowest]": timings, "bytes": bytes_of, "machine": machine}}
