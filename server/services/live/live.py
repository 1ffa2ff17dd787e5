"""Computes the subject's head while clients request it.

One thread takes pictures, unless the console's live view provides them; another thread sends them to a child process
(``looking``) and publishes the result. The next pictures are requested early enough to arrive when the child process is
done. The child process has priority over a job and takes at most a quarter of its two cores; a child process that dies
or hangs is replaced at the next pictures. ``IDLE_S`` seconds after the last request, threads and child process end.
"""

import threading
import time
from collections.abc import Mapping
from dataclasses import dataclass
from datetime import UTC, datetime
from pathlib import Path

import cv2
import numpy as np
import structlog

from rig.formats.rig_toml import read_rig_config
from rig.image import ImageRgb
from rig.messages.message import Message, compose
from rig.progress import Progress
from rig.rig import Rig
from server.errors import Refused
from server.services.live.seen import LiveOut, Seen, Word, word_out
from server.services.live.words import Speaker, lamps_of
from server.services.rigs import RigBackend
from server.tasks.child import Child, WorkerContext

EVERY_S = 0.3  # from look to look at least
IDLE_S = 6.0  # without anybody who asks
AGAIN_S = 1.0  # after a fault
LOOK_S, FIRST_LOOK_S = 4.0, 40.0  # that the child may take; the first one reads model and networks
OFFERED_S = 1.0  # pictures that are offered so lately are waited for: the cameras are looked at once
FRESH_S = 3.0  # a look so old says nothing about now
PAUSE_S = 0.02  # between two looks at least
WIDTH_PX = 480  # of pictures that the child gets, at least
NICENESS = 2  # a job's processes have 5: half a core of 0.15 s a look must not wait for their two
HEAD_SHOWN = {"vertices", "triangles", "left_deg", "up_deg", "eyes_open"}

log = structlog.get_logger()


@dataclass(frozen=True, slots=True)
class Moment:
    """Holds the pictures of one moment, some of them as JPEG files, and the earliest time at which they may have been
    taken (s, of ``time.monotonic``). ``fault``: why there are no pictures."""

    taken_s: float
    pictures: Mapping[str, bytes | ImageRgb]
    fault: Message | None = None


class Live:
    """Finds the head while clients request it. ``rig_toml`` describes the rig; None: the simulated studio."""

    def __init__(self, rig: RigBackend, rig_toml: Path | None) -> None:
        self._rig = rig
        self._config = None if rig_toml is None else read_rig_config(rig_toml)
        self._lock = threading.Lock()
        self._thread: threading.Thread | None = None
        self._asked_s = self._offered_s = self._polled_s = 0.0
        self._moment: Moment | None = None
        self._taken = threading.Event()  # set by each moment
        self._begun, self._child_s = threading.Event(), 0.0  # whether the child looks at the newest; how long it took
        self._shown: tuple[float, LiveOut] | None = None
        self._number = 0
        self._closing = False

    def newest(self) -> LiveOut:
        """Returns the newest result, and requests further results. Before the first result, and when the cameras are
        lost, the answer has no cameras and states the reason. Does not block."""
        self._polled_s = time.monotonic()
        return self._newest()

    def _newest(self) -> LiveOut:
        self._asked_s = now_s = time.monotonic()
        with self._lock:
            if self._thread is None and not self._closing:
                self._thread = threading.Thread(target=self._look_on, daemon=True, name="live head")
                self._thread.start()
        shown = self._shown
        return shown[1] if shown is not None and now_s - shown[0] < FRESH_S else nothing(compose("live-starting"))

    def offer(self, pictures: Mapping[str, bytes], taken_s: float) -> LiveOut:
        """Receives pictures from the live view, so that the cameras need not take them twice, and returns the newest
        result."""
        self._offered_s = time.monotonic()
        self._hand_on(Moment(taken_s, pictures))
        return self._newest()

    def close(self) -> None:
        """Ends the threads and the child process."""
        self._closing, thread = True, self._thread
        self._taken.set()
        if thread is not None:
            thread.join(LOOK_S)

    def _look_on(self) -> None:
        speaker, child, last_s = Speaker(), Child(NICENESS, {"OPENBLAS_NUM_THREADS": "1"}), 0.0
        ended = threading.Event()
        threading.Thread(target=self._watch_cameras, args=(ended,), daemon=True, name="live pictures").start()
        try:
            while not self._is_idle():
                self._taken.wait(EVERY_S)
                self._taken.clear()
                moment = self._moment
                if moment is None or moment.taken_s <= last_s:
                    continue
                last_s = moment.taken_s
                self._begun.set()
                try:
                    self._show(moment, child, speaker)
                except Exception as error:  # the child is begun again
                    self._shown = (time.monotonic(), nothing(compose("live-again")))
                    log.warning("no live head", error=str(error)[:300])
                    ended.wait(AGAIN_S)
        finally:
            ended.set()
            child.close()

    def _watch_cameras(self, ended: threading.Event) -> None:
        while not ended.is_set():
            begun_s = time.monotonic()
            if begun_s - self._offered_s < OFFERED_S or begun_s - self._polled_s > IDLE_S:
                ended.wait(EVERY_S)
                continue
            self._begun.clear()
            try:
                pictures = {name: halved(image) for name, image in self._rig.look().items()}
                self._hand_on(Moment(begun_s, pictures))
            except Exception as error:  # the cameras may come back
                fault = error.detail if isinstance(error, Refused) else compose("live-no-pictures")
                self._hand_on(Moment(begun_s, {}, fault))
                ended.wait(AGAIN_S)
            took_s = time.monotonic() - begun_s
            self._begun.wait(LOOK_S)
            ended.wait(max(PAUSE_S, self._child_s - took_s, begun_s + EVERY_S - time.monotonic()))

    def _hand_on(self, moment: Moment) -> None:
        self._moment = moment
        self._taken.set()

    def _is_idle(self) -> bool:
        with self._lock:
            idle = self._closing or time.monotonic() - self._asked_s > IDLE_S
            if idle:
                self._thread, self._shown, self._moment = None, None, None
            return idle

    def _show(self, moment: Moment, child: Child, speaker: Speaker) -> None:
        if moment.fault is not None:
            self._shown = (time.monotonic(), nothing(moment.fault))
            return
        begun_s = time.monotonic()
        until_s = begun_s + (LOOK_S if child.runs else FIRST_LOOK_S)
        seen: Seen = child.remote(look, cancelled=lambda: self._closing or time.monotonic() > until_s)(
            pictures=moment.pictures,
            rig=self._rig.calibrated(),
            front=None if self._config is None else self._config.front,
            plates=self._plates(),
        )
        now_s = time.monotonic()
        self._child_s, self._number = now_s - begun_s, self._number + 1
        words, steady = speaker.words(seen, moment.taken_s), speaker.steady(seen.head, moment.taken_s)
        opened = seen.head is not None and seen.head.eyes_open is True
        shown = LiveOut(
            time=datetime.fromtimestamp(time.time() + moment.taken_s - now_s, UTC).isoformat(timespec="milliseconds"),
            age_s=round(now_s - moment.taken_s, 3),
            number=self._number,
            cameras=lamps_of(seen),
            head=seen.head,
            steady=steady,
            words=[word_out(word) for word in words],
            ready=steady and opened and not words,
        )
        self._shown = (now_s, shown)

    def _plates(self) -> tuple[str, str] | None:
        in_use = next((version for version in self._rig.plates() if version.in_use), None)
        return None if in_use is None or self._config is None else (str(self._config.plates_folder), in_use.id)


def nothing(why: Message) -> LiveOut:
    """Returns a result without a head, for the reason ``why``."""
    return LiveOut(
        time="", age_s=0.0, number=0, cameras={}, head=None, steady=False, words=[word_out(Word(why))], ready=False
    )


def halved(image: ImageRgb) -> ImageRgb:
    """Returns a picture reduced by a whole factor (which is fast), at least ``WIDTH_PX`` wide."""
    factor = max(1, image.shape[1] // WIDTH_PX)
    size = (image.shape[1] // factor, image.shape[0] // factor)
    return image if factor == 1 else np.asarray(cv2.resize(image, size, interpolation=cv2.INTER_AREA), np.uint8)


def look(
    context: WorkerContext,
    report: Progress,
    *,
    pictures: Mapping[str, bytes | ImageRgb],
    rig: Rig | None,
    front: str | None,
    plates: tuple[str, str] | None,
) -> Seen:
    """Finds the head in pictures, in the child process, by ``looking.look``."""
    from server.services.live import looking

    return looking.look(context, pictures, rig, front, plates)


def document_of(shown: LiveOut) -> dict[str, object]:
    """Returns a result as JSON types, for a page."""
    head = None if shown.head is None else shown.head.model_dump(include=HEAD_SHOWN)
    words = [{**word.message.model_dump(), "camera": word.camera} for word in shown.words]
    return shown.model_dump(exclude={"head", "words"}) | {"head": head, "words": words}
