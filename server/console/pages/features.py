"""Features: the seven points of section 4.2, picked in three or four views. Skipping this page is fine: without points
the pipeline finds the alignment by itself."""

import threading
from pathlib import Path
from typing import Any

import numpy as np
from nicegui import ui
from starlette.responses import RedirectResponse

from pipeline.eigenheads.landmarks import SEVEN_POINTS
from rig.formats.cameras_file import find_rig_file, read_rig_file
from rig.rig import Rig
from server.console.guides import helps, mean_landmarks, nearest_views
from server.console.page import Action, Page, shared, show
from server.console.removal import removals
from server.services.jobs import Work
from server.services.service import Service

VIEWS = 4
FORMAT = "eigenhead-features/1"


class FeaturesPage(Page, component="features.js"):
    """The points are the page's own until they are saved."""

    def look(self) -> dict[str, Any]:
        captures = [
            {key: c[key] for key in ("id", "label", "created", "features")}
            for c in self.service.store.captures()
            if not c.get("board") and c["id"] not in removals
        ]
        chosen = self.choice.get("capture") or (captures[0]["id"] if captures else None)
        if chosen is None or all(capture["id"] != chosen for capture in captures):
            return {"captures": captures, "capture": None, "asked": self.choice.get("capture")}
        return {"captures": captures, "capture": self._picking(chosen)}

    def _picking(self, capture_id: str) -> dict[str, Any]:
        if self.choice.get("of") != capture_id:
            saved = self.service.captures.features(capture_id)
            self.choice |= {"of": capture_id, "points": saved, "saved": saved}
        record = self.service.store.capture(capture_id)
        rig = shared.get(("cameras", capture_id), 3600.0, lambda: rig_of(self.service, capture_id))
        points = self.choice["points"]
        pixels = {p: {c: np.array(at, float) for c, at in views.items()} for p, views in points.items()}
        return {
            "id": capture_id,
            "cameras": record["cameras"],
            "views": nearest_views(rig, record["front"], VIEWS),
            "names": list(SEVEN_POINTS),
            "points": points,
            "dirty": points != self.choice["saved"],
            **helps(rig, pixels, landmarks.of(self.service)),
        }


def rig_of(service: Service, capture_id: str) -> Rig:
    path = find_rig_file(service.store.folder("captures", capture_id) / "files")
    assert path is not None  # it was accepted with one
    return read_rig_file(Path(path))


class Landmarks:
    """The seven landmarks of the default model's mean head (head frame, mm). Loading a model takes a second or more:
    it is asked for once, in a thread, and the page works without until it is there."""

    def __init__(self) -> None:
        self._asked = threading.Lock()
        self.found: dict[str, np.ndarray] = {}

    def of(self, service: Service) -> dict[str, np.ndarray]:
        if not self.found and self._asked.acquire(blocking=False):
            threading.Thread(target=self._load, args=(service,), daemon=True).start()
        return self.found

    def _load(self, service: Service) -> None:
        try:
            with service.children.one() as child:
                arguments = {"model": "default", "names": list(SEVEN_POINTS)}
                found = child.remote(mean_landmarks)(**arguments)
            self.found = {name: np.array(point) for name, point in found.items()}
        finally:
            self._asked.release()


landmarks = Landmarks()


def place(page: Page, event: dict[str, Any]) -> None:
    """Sets one point in one view, or takes it back where ``at`` is null."""
    points = {name: dict(views) for name, views in page.choice["points"].items()}
    views = points.setdefault(event["point"], {})
    if event["at"] is None:
        views.pop(event["camera"], None)
    else:
        views[event["camera"]] = [round(float(value), 2) for value in event["at"]]
    page.choice["points"] = {name: views for name, views in points.items() if views}


def save(page: Page, event: dict[str, Any]) -> str:
    points = page.choice["points"]
    page.service.captures.put_features(page.choice["of"], {"format": FORMAT, "points": points})
    page.choice["saved"] = points
    return "Saved. Jobs from now on use these points."


def reconstruct(page: Page, event: dict[str, Any]) -> str:
    if page.choice["points"] != page.choice["saved"]:
        save(page, event)
    job = page.service.jobs.submit(page.choice["of"], Work(), key=page.caller.key)
    return f"Queued job {job['id'][-6:]}. Watch it on the page Jobs."


FeaturesPage.actions = {
    "place": Action("read", place),
    "save": Action("capture", save),
    "reconstruct": Action("submit", reconstruct),
}


@ui.page("/features")
@ui.page("/features/{capture}")
async def features_page(capture: str = "") -> RedirectResponse | None:
    return await show("features", FeaturesPage, capture=capture or None)
