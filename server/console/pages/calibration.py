"""Implements the page Calibration: shots of the board with live coverage, reports, the calibration in use, and earlier
ones."""

import threading
from collections.abc import Mapping

from calibration.board.board import board_from_document
from rig.errors import InputError
from rig.messages.message import Message, compose
from server.console.coverage import Corners, advice, detect_shot, summary
from server.console.page import Action, Page, remove_later, serve_page, shared, shown_failure
from server.console.removal import removals
from server.errors import Conflict, InvalidInput
from server.services.captures import CaptureMetadata
from server.services.records import CalibrationOut
from server.services.service import Service
from server.storage.records import JsonObject

LABEL = "calibration board"
SHOTS_LEAST = 3
NO_BOARD = compose("studio-without-board")


class Shots:
    """Collects shots of the board for a calibration. A service process has one collection of shots, which all pages
    show; a restart empties the collection. Thread-safe."""

    def __init__(self) -> None:
        self._lock = threading.Lock()
        self.board: Mapping[str, object] = {}
        self.taken: list[tuple[str, Corners]] = []

    def add(self, board: Mapping[str, object], capture: str, corners: Corners) -> None:
        """Adds a shot: the id of its capture, and the corners detected in each camera's picture."""
        with self._lock:
            self.board, self.taken = board, [*self.taken, (capture, corners)]

    def check(self, board: Mapping[str, object]) -> None:
        """Raises Conflict if the shots collected so far show a different board."""
        with self._lock:
            if self.taken and board != self.board:
                detail = compose("shots-of-other-board", count=len(self.taken))
                raise Conflict("other-board", detail)

    def drop_last(self) -> None:
        """Removes the last shot from the collection; its capture stays."""
        with self._lock:
            self.taken = self.taken[:-1]
            self.board = self.board if self.taken else {}

    def clear(self) -> None:
        """Empties the collection; the captures stay."""
        with self._lock:
            self.board, self.taken = {}, []


shots = Shots()


class CalibrationPage(Page, component="calibration.js"):
    """Shows the shots of the board so far, and the list of calibrations with their reports."""

    def look(self) -> JsonObject:
        """Returns the state of the page, which is the same for all callers."""
        return shared.get("calibration page", 0.4, lambda: calibration_state(self.service))


def known_calibrations(service: Service, age_s: float) -> list[CalibrationOut]:
    """Returns all calibrations, newest first. The pages share the list, which is at most ``age_s`` seconds old."""
    return shared.get("calibrations", age_s, service.calibrations.find)


def calibration_state(service: Service) -> JsonObject:
    """Returns what the page shows: calibrations, rig, and the coverage of the board's shots so far with advice for the
    next shot. ``is_measured``: whether a calibration that this service made is in use."""
    rig = service.rig.describe()
    names = [camera.name for camera in rig.cameras]
    lines = summary(names, [corners for _, corners in shots.taken])
    return {
        "calibrations": [
            c.model_dump() | {"error": shown_failure(c.error)}
            for c in known_calibrations(service, 1.0)
            if c.id not in removals
        ],
        "rig": {
            "kind": rig.kind,
            "calibration": rig.calibration,
            "is_measured": service.calibrations.in_use() is not None,
        },
        "board": shots.board,
        "shots": len(shots.taken),
        "coverage": lines,
        "advice": (NO_BOARD if rig.kind == "simulated" and not shots.taken else advice(lines)).document(),
    }


def board_of(event: JsonObject) -> Mapping[str, object]:
    """Reads the board that a form describes, as the content of a ``board.toml``. Raises InputError naming missing
    keys."""
    form = event.get("board") or {}
    needed = ("kind", "columns", "rows", "square_mm")
    other = ("measured_width_mm", "inverted") + (("marker_ratio", "dictionary") * (form.get("kind") == "charuco"))
    board = {key: form[key] for key in needed + other if form.get(key) not in (None, "", False)}
    if missing := [compose("board-key-missing", key=key) for key in needed if key not in board]:
        raise InputError("board", missing)
    return board


def shoot(page: Page, event: JsonObject) -> Message:
    """Takes a shot of the board and adds it to the collection. A shot in which no camera sees the board is removed.

    Raises InputError for an impossible board, Conflict if earlier shots show a different board, InvalidInput if no
    camera sees the board, and what ``Captures.take`` raises.
    """
    board, service = board_of(event), page.service
    board_from_document(board)
    shots.check(board)
    identity = service.captures.take(CaptureMetadata(label=LABEL), board=True).id
    files = service.store.capture_files(identity)
    with service.children.one() as child:
        corners_of = child.remote(detect_shot)(files=str(files), board=board)
    cameras_with_board = sum(bool(corners) for corners in corners_of.values())
    if not cameras_with_board:
        service.store.remove_capture(identity, later=True)
        detail = compose("board-not-seen")
        raise InvalidInput("no-board", detail)
    shots.add(board, identity, corners_of)
    shared.forget("calibration page")
    return compose("board-shot-taken", number=len(shots.taken), seen=cameras_with_board, all=len(corners_of))


def take_back(page: Page, event: object) -> None:
    """Removes the last shot of the board from the collection."""
    shots.drop_last()
    shared.forget("calibration page")


def start_over(page: Page, event: object) -> None:
    """Empties the collection of board shots; the captures stay."""
    shots.clear()
    shared.forget("calibration page")


def calibrate(page: Page, event: JsonObject) -> Message:
    """Queues a calibration from the collected shots and empties the collection. Raises InvalidInput for fewer than
    ``SHOTS_LEAST`` shots."""
    if len(shots.taken) < SHOTS_LEAST:
        detail = compose("board-shots-too-few", count=len(shots.taken), needed=SHOTS_LEAST)
        raise InvalidInput("too-few-shots", detail)
    captures = [capture for capture, _ in shots.taken]
    page.service.calibrations.add_shots(shots.board, captures, str(event.get("label") or "")[:500])
    shots.clear()
    _forget()
    return compose("calibration-queued")


def use(page: Page, event: JsonObject) -> Message:
    """Selects a calibration for every later capture; with ``poor`` even a calibration with the verdict poor, whose
    faults the operator has read. Raises NotFound and Conflict as ``Service.use_calibration`` does."""
    page.service.use_calibration(event["id"], poor=event.get("poor", False))
    _forget()
    return compose("calibration-taken-into-use")


def remove(page: Page, event: JsonObject) -> None:
    """Removes a calibration after the time to undo has passed. Raises NotFound."""
    service, identity = page.service, event["id"]
    calibration = service.calibrations.get(identity)
    title = compose("calibration-named", name=calibration.label or identity[-6:])
    remove_later(identity, lambda: service.calibrations.remove(identity), title, "capture")


def _forget() -> None:
    for key in ("calibrations", "calibration page", "rig"):
        shared.forget(key)


CalibrationPage.actions = {
    "shoot": Action("capture", shoot),
    "take_back": Action("capture", take_back),
    "start_over": Action("capture", start_over),
    "calibrate": Action("capture", calibrate),
    "use": Action("capture", use),
    "remove": Action("capture", remove),
}


serve_page("calibration", CalibrationPage, choices=("calibration",), paths=("/calibration",))
