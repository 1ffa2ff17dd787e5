"""Implements the page Features, where the operator picks the paper's seven points (section 4.2) and others in views.

Picking is optional: without points the pipeline finds the alignment itself.
"""

import threading
from collections import OrderedDict
from collections.abc import Iterator, Mapping
from dataclasses import asdict, dataclass, field

import numpy as np

from pipeline.head_model.landmarks import NAMES, SEVEN_POINTS
from rig.messages.message import Message, MessageDocument, compose
from server.console.guides import Guides, mean_landmarks, nearest_views
from server.console.media import found_faces, rig_of
from server.console.page import Action, Page, serve_page, shared
from server.console.removal import removals
from server.errors import Conflict, InvalidInput
from server.services.service import Service
from server.services.work import ReconstructionRequest
from server.storage.face_cache import PixelsOfPoints
from server.storage.library import CaptureQuery
from server.storage.records import CaptureRecord, JsonObject
from server.tasks.ingest import Points

VIEWS = 4
CHOICES = 100  # captures to choose from; the page Captures leads to all


@dataclass(slots=True)
class Picked:
    """Holds the points of a capture as shown on the page, and as last saved.

    ``suggested``: pixels from a detected face, for points that are not set in that view; they count only after the
    operator accepts them. ``unconfirmed``: the points whose contradictions the operator was asked to confirm.
    """

    capture: str
    points: Points
    saved: Points
    guides: Guides
    suggested: Points = field(default_factory=dict)
    unconfirmed: Points | None = None


class Drafts:
    """Keeps unsaved points for each operator and capture, so that a reload of the page shows them again. Unsaved points
    are lost when the process ends."""

    def __init__(self, most: int = 200) -> None:
        self._most, self._kept = most, OrderedDict[tuple[str, str], Points]()

    def keep(self, caller: str, picked: Picked) -> None:
        """Stores the points of a page for a caller, or drops the draft if all points are saved. If there are too many
        drafts, the oldest drafts are dropped."""
        self._kept.pop((caller, picked.capture), None)
        if picked.points != picked.saved:
            self._kept[caller, picked.capture] = picked.points
            while len(self._kept) > self._most:
                self._kept.popitem(last=False)

    def of(self, caller: str, capture: str) -> Points | None:
        """Returns a caller's unsaved points for a capture; None if there are none."""
        return self._kept.get((caller, capture))


drafts = Drafts()


class FeaturesPage(Page, component="features.js"):
    """Shows the views of one capture, in which feature points are picked. Each open page has its own points until they
    are saved."""

    picked: Picked | None = None

    def look(self) -> JsonObject:
        """Returns the captures to choose from, and the points of the chosen capture with the aids for picking more."""
        captures: list[JsonObject] = shared.get("choices", 2.0, lambda: captures_to_pick(self.service))
        chosen = self.choice.get("capture") or (captures[0]["id"] if captures else None)
        known = any(capture["id"] == chosen for capture in captures)
        if not known and chosen is not None:  # an older one, by its address
            older = [record for record in self.service.captures.of([chosen]) if not record.board]
            captures = [*captures, *(choice_of(record) for record in older if record.id not in removals)]
            known = bool(older)
        if chosen is None or not known:
            return {"captures": captures, "capture": None, "requested": self.choice.get("capture")}
        return {"captures": captures, "capture": self._picking(chosen)}

    def _picking(self, capture_id: str) -> JsonObject:
        """Returns the points of one capture and the aids for picking more, in pixels of the picture files.

        ``names``: all points, first the seven of section 4.2; ``suggested``: suggestions that nobody has accepted yet;
        ``dirty``: some points are not saved; ``is_contradictory``: contradictions must be confirmed before the points
        are saved.
        """
        record = self.service.store.capture(capture_id)
        rig = shared.get(("cameras", capture_id), 3600.0, lambda: rig_of(self.service.store.capture_files(capture_id)))
        picked = self.picked
        if picked is None or picked.capture != capture_id:
            saved = self.service.captures.features(capture_id)
            draft = drafts.of(self.caller.key, capture_id)
            self.picked = picked = Picked(capture_id, saved if draft is None else draft, saved, Guides(rig))
        points = picked.points
        pixels = {p: {c: np.array(at, float) for c, at in views.items()} for p, views in points.items()}
        shown = self.choice.get("point") or SEVEN_POINTS[0]
        nearest, chosen = nearest_views(rig, record.front, VIEWS), self.choice.get("views")
        return {
            "id": capture_id,
            "cameras": [asdict(camera) for camera in record.cameras],
            "views": nearest,
            "names": [*SEVEN_POINTS, *(name for name in NAMES if name not in SEVEN_POINTS)],
            "points": points,
            "suggested": picked.suggested,
            "dirty": points != picked.saved,
            "is_contradictory": picked.unconfirmed == points,
            **picked.guides.helps(
                pixels, landmarks.of(self.service), [shown], chosen.split("\n") if chosen else nearest
            ),
        }

    def of_capture(self) -> Picked:
        """Returns the points that are being picked. Raises Conflict if the page has not shown a capture yet."""
        if self.picked is None:
            raise Conflict("no-capture", compose("no-capture-shown"))
        return self.picked


def captures_to_pick(service: Service) -> list[JsonObject]:
    """Returns the newest ``CHOICES`` captures that show a head."""
    captures = service.captures.page(CaptureQuery(board=False), CHOICES)
    return [choice_of(record) for record in captures.items if record.id not in removals]


def choice_of(record: CaptureRecord) -> JsonObject:
    """Converts a capture's record to an entry of the list to choose from."""
    return {"id": record.id, "label": record.label, "created": record.created, "features": record.features}


class Landmarks:
    """Holds the landmarks of the default model's mean head (head frame, mm). The landmarks are loaded in a thread,
    which takes a second or more; until then none are known."""

    def __init__(self) -> None:
        self._asked = threading.Lock()
        self.found: dict[str, np.ndarray] = {}

    def of(self, service: Service) -> dict[str, np.ndarray]:
        """Returns the landmarks loaded so far, and starts to load them at the first call."""
        if not self.found and self._asked.acquire(blocking=False):
            threading.Thread(target=self._load, args=(service,), daemon=True).start()
        return self.found

    def _load(self, service: Service) -> None:
        try:
            with service.children.one() as child:
                means = child.remote(mean_landmarks)(model="default", names=list(NAMES))
            self.found = {name: np.array(point) for name, point in means.items()}
        finally:
            self._asked.release()


landmarks = Landmarks()


def place(page: FeaturesPage, event: JsonObject) -> None:
    """Sets one ``point`` in the view of one ``camera``, or removes it if ``at`` is None. Saves nothing yet."""
    picked = page.of_capture()
    points = {name: dict(views) for name, views in picked.points.items()}
    views = points.setdefault(event["point"], {})
    if event["at"] is None:
        views.pop(event["camera"], None)
    else:
        views[event["camera"]] = [round(float(value), 2) for value in event["at"]]
    picked.points = {name: views for name, views in points.items() if views}
    picked.suggested = open_suggestions(picked.suggested, picked.points)
    drafts.keep(page.caller.key, picked)


def suggest(page: FeaturesPage, event: object) -> Message:
    """Suggests all seven points in every view that shows the face. Suggestions are neither saved nor used until the
    user accepts them. Raises InvalidInput if no face is found with certainty, and what ``found_faces`` raises."""
    picked = page.of_capture()
    suggested = found_faces(page.service, picked.capture)["suggested"]
    if not suggested:
        raise InvalidInput("no-subject", compose("nothing-suggested"))
    picked.suggested = open_suggestions(suggested, picked.points)
    return compose("points-suggested", count=sum(len(views) for views in picked.suggested.values()))


def accept(page: FeaturesPage, event: JsonObject) -> None:
    """Turns suggestions into points: of one ``point`` in one ``camera``, of one point in all cameras, or of all points.
    Accepted points are saved like all other points."""
    picked = page.of_capture()
    picked.points = take_suggestions(picked.points, picked.suggested, event.get("point"), event.get("camera"))
    picked.suggested = open_suggestions(picked.suggested, picked.points)
    drafts.keep(page.caller.key, picked)


def reject(page: FeaturesPage, event: JsonObject) -> None:
    """Drops the selected suggestions of points without setting the points."""
    picked = page.of_capture()
    picked.suggested = drop_suggestions(picked.suggested, event.get("point"), event.get("camera"))


def save(page: FeaturesPage, event: JsonObject) -> Message | None:
    """Stores the points of the page. If views contradict each other, the function stores nothing and returns None until
    the user confirms (``sure`` in the event). Raises what ``Captures.put_features`` raises."""
    picked = page.of_capture()
    points = picked.points
    if not event.get("sure") and contradictions(page):
        picked.unconfirmed = points
        return None
    page.service.captures.put_features(picked.capture, points)
    picked.saved, picked.unconfirmed = points, None
    drafts.keep(page.caller.key, picked)
    return compose("features-saved")


def contradictions(page: FeaturesPage) -> Mapping[str, MessageDocument]:
    """Returns, by point, the pixels that a job would leave out because views contradict each other."""
    picked = page.of_capture()
    pixels = {p: {c: np.array(at, float) for c, at in views.items()} for p, views in picked.points.items()}
    return picked.guides.helps(pixels, {}, [])["contradictions"]


def reconstruct(page: FeaturesPage, event: JsonObject) -> Message | None:
    """Saves the points if needed, and queues a job for the capture. If the user must confirm contradictions first, no
    job is queued and the function returns None."""
    picked = page.of_capture()
    if picked.points != picked.saved and save(page, event) is None:
        return None
    job = page.service.jobs.submit(picked.capture, ReconstructionRequest(), key=page.caller.key)
    page.started(job.id, opens=True)
    return compose("job-queued-watch", job=job.id[-6:])


FeaturesPage.actions = {
    "place": Action("read", place),
    "suggest": Action("read", suggest),
    "accept": Action("read", accept),
    "reject": Action("read", reject),
    "save": Action("capture", save),
    "reconstruct": Action("submit", reconstruct),
}


serve_page("features", FeaturesPage, choices=("capture",), paths=("/features", "/features/{capture}"))


def open_suggestions(suggested: PixelsOfPoints, points: PixelsOfPoints) -> PixelsOfPoints:
    """Returns the suggestions (pixels, by point and camera) without those for views in which the point is set
    already."""
    left = {
        name: {camera: at for camera, at in views.items() if camera not in points.get(name, {})}
        for name, views in suggested.items()
    }
    return {name: views for name, views in left.items() if views}


def take_suggestions(
    points: PixelsOfPoints, suggested: PixelsOfPoints, point: str | None = None, camera: str | None = None
) -> PixelsOfPoints:
    """Returns the points with suggestions added: those of ``point`` in the view ``camera``, of ``point`` in all views
    if ``camera`` is None, or all if both are None. Points that are set already keep their pixels."""
    taken = {name: dict(views) for name, views in points.items()}
    for name, view, at in _of(open_suggestions(suggested, points), point, camera):
        taken.setdefault(name, {})[view] = at
    return taken


def drop_suggestions(suggested: PixelsOfPoints, point: str | None = None, camera: str | None = None) -> PixelsOfPoints:
    """Returns the suggestions without those of ``point`` in the view ``camera``, of ``point`` in all views if
    ``camera`` is None, or without any if both are None."""
    left = {name: dict(views) for name, views in suggested.items()}
    for name, view, _ in _of(suggested, point, camera):
        left[name].pop(view)
    return {name: views for name, views in left.items() if views}


def _of(suggested: PixelsOfPoints, point: str | None, camera: str | None) -> Iterator[tuple[str, str, list[float]]]:
    for name, views in suggested.items():
        for view, at in views.items():
            if point in (None, name) and camera in (None, view):
                yield name, view, at
