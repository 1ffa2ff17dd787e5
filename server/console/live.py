"""Provides the live view: one thread takes pictures while a page is open, and every open page gets the pictures."""

import asyncio
import json
import struct
import threading
import time
from collections.abc import AsyncIterator

import structlog

from rig.image import ImageRgb
from rig.messages.message import Message, compose
from rig.progress import Progress
from server.console.live_frame import measured_frame
from server.services.live.live import document_of
from server.services.rigs import PREVIEW_WIDTH, RigBackend, encode_jpeg, reduced
from server.services.service import Service
from server.storage.records import JsonObject
from server.tasks.child import Child, WorkerContext
from server.wire.problems import problem_from

EVERY_S = 0.25  # four looks a second at most
IDLE_S = 3.0  # without anybody who watches: then nobody looks at the cameras either
KEEP_S = 300.0  # and so long the studio stays drawn, for the next who comes
LOOK_S = 0.05
AGAIN_S = 1.0  # after an error

log = structlog.get_logger()


def _frame(name: str, picture: ImageRgb | None, sharp: bool) -> JsonObject:
    if picture is None:
        return {"name": name, "jpeg": None, "fault": compose("camera-shows-nothing").document()}
    small = reduced(picture, PREVIEW_WIDTH)  # a tile is 320 points wide, twice as many pixels on a dense screen
    return measured_frame(name, small, encode_jpeg(small), picture if sharp else None)


def rig_frames(rig: RigBackend, child: Child, look: int) -> list[JsonObject]:
    """Returns the current picture of each camera, with its measurements. ``child`` draws the simulated studio; real
    cameras take their pictures at once, and the sharpness of one camera, in turn, is measured at full size. ``look``
    counts the calls. Raises Unavailable if the rig cannot be opened."""
    described = rig.describe()
    if described.kind == "simulated":
        return child.remote(frames)(look=look)
    pictures, names = rig.look(), [camera.name for camera in described.cameras]
    return [_frame(name, pictures.get(name), look % len(names) == i) for i, name in enumerate(names)]


class LiveView:
    """Holds the newest pictures of all cameras, numbered. The view's thread takes pictures while pages are open, and
    ends ``KEEP_S`` seconds after the last page closed."""

    def __init__(self, service: Service) -> None:
        self._service = service
        self._lock = threading.Lock()
        self._thread: threading.Thread | None = None
        self._watched = 0.0
        self._latest: tuple[int, bytes] = (0, b"")
        self.fault: Message | None = None

    async def stream(self) -> AsyncIterator[bytes]:
        """Yields the pictures of all cameras as they are taken, each time as one message of ``look_bytes``. Starts the
        thread that takes the pictures if needed."""
        shown = 0
        while True:
            self._watch()
            number, message = self._latest
            if number != shown and message:
                shown = number
                yield message
            await asyncio.sleep(LOOK_S)

    def _watch(self) -> None:
        self._watched = time.monotonic()
        with self._lock:
            if self._thread is None:
                self._thread = threading.Thread(target=self._look_around, daemon=True, name="live view")
                self._thread.start()

    def _look_around(self) -> None:
        child, number = Child(), 0
        blur: dict[str, float | None] = {}
        try:
            while True:
                began = time.monotonic()
                with self._lock:
                    if began - self._watched > KEEP_S:
                        self._thread = None
                        return
                if began - self._watched > IDLE_S:
                    self._latest = (self._latest[0], b"")  # who comes next must not take it for the present
                    time.sleep(LOOK_S)
                    continue
                try:
                    number += 1
                    message = self._look(child, number, blur)
                except Exception as error:  # the rig may come back
                    problem = problem_from(error)
                    log.warning("no live view", error=problem.detail.text)
                    self.fault, message = problem.detail, look_bytes([], problem.detail)
                    time.sleep(AGAIN_S)
                self._latest = (self._latest[0] + 1, message)
                time.sleep(max(0.0, EVERY_S - (time.monotonic() - began)))
        finally:
            child.close()

    def _look(self, child: Child, look: int, blur: dict[str, float | None]) -> bytes:
        began = time.monotonic()
        frames = rig_frames(self._service.rig, child, look)
        for frame in frames:
            if "blur_px" in frame:
                blur[frame["name"]] = frame["blur_px"]
            frame["blur_px"] = blur.get(frame["name"])
        shown = self._service.live.offer({f["name"]: data for f in frames if (data := f["jpeg"])}, began)
        self.fault = None
        return look_bytes(frames, None, document_of(shown))


def look_bytes(frames: list[JsonObject], fault: Message | None, head: object = None) -> bytes:
    """Encodes the pictures of all cameras as one message: 4 bytes with the header's length, 4 with the length of the
    rest (both big-endian), a JSON header, and the JPEG files in the header's order. The header's ``bytes`` holds the
    length of each JPEG file."""
    header = [{k: v for k, v in f.items() if k != "jpeg"} | {"bytes": len(f["jpeg"] or b"")} for f in frames]
    text = json.dumps({"cameras": header, "fault": None if fault is None else fault.document(), "head": head}).encode()
    body = b"".join(f["jpeg"] or b"" for f in frames)
    return struct.pack(">II", len(text), len(body)) + text + body


def frames(context: WorkerContext, report: Progress, *, look: int) -> list[JsonObject]:
    """Returns the current picture of each camera of the simulated studio, drawn in a child process. ``look`` counts the
    calls."""
    from server.console import studio_drawing

    return studio_drawing.frames(context, look)
