"""Runs each camera in a thread that opens it, grabs frames continuously, and decodes requested frames.

A driver may block forever inside a vendor's library. Therefore every camera has a separate thread, and every wait has a
deadline. If a camera's daemon thread does not end, the program reports this and continues without the thread.
"""

import contextlib
import threading
import time
from collections import deque
from dataclasses import dataclass
from statistics import median

from rig.drivers.base import Arrival, CameraLost, Driver, DriverError, Frame, GrabTimeout, upright
from rig.formats.rig_toml import CameraConfig
from rig.messages.message import Message, compose

_SLICE_S = 0.2  # how long a grab may hold up closing
_SOFTWARE_SLICE_S = 0.02  # and the command to a camera that is triggered by software
_REOPEN_S = 1.0  # after a camera was lost
_SLOWEST_S = 1.0  # between frames of a camera that runs by itself: what comes more rarely was released, one by one
_KEPT = 32  # frames that wait to be collected: half a second at 60 a second


@dataclass(frozen=True, slots=True)
class FeedState:
    """Holds the current state of one camera. The state's times are in seconds of time.monotonic. ``unmet`` lists the
    settings that the camera refused."""

    opened: bool
    last_seen_s: float | None
    period_s: float | None  # between frames of a camera that runs by itself
    error: Message | None
    unmet: tuple[Message, ...]  # settings that the camera did not take


class CameraFeed:
    """Runs one camera's driver in a thread. Each method that waits has a deadline, in seconds of time.monotonic."""

    def __init__(self, camera: CameraConfig, driver: Driver, open_timeout_s: float) -> None:
        self.camera = camera
        self.live = driver.live
        self._driver = driver
        self._open_timeout_s = open_timeout_s
        self._stop = threading.Event()
        self._release = threading.Event()
        self._changed = threading.Condition()
        self._frames: deque[Frame] = deque(maxlen=_KEPT)
        self._wanted_from_s: float | None = None
        self._due_s: float | None = None
        self._arrivals_s: deque[float] = deque(maxlen=8)
        self._opened = False
        self._count = 0
        self._error: DriverError | None = None
        self._unmet: tuple[Message, ...] = ()
        self._thread = threading.Thread(target=self._run, name=f"camera {camera.name}", daemon=True)

    def start(self) -> None:
        """Starts the thread, which opens the camera."""
        self._thread.start()

    def stop(self) -> None:
        """Requests the end of the thread without waiting; ``close`` waits."""
        self._stop.set()

    def close(self, deadline_s: float) -> bool:
        """Ends the camera's thread. Returns False if the driver still blocks the thread at the deadline."""
        self.stop()
        if self._thread.ident is not None:
            self._thread.join(max(0.0, deadline_s - time.monotonic()))
        return not self._thread.is_alive()

    def state(self) -> FeedState:
        """Returns the camera's current state."""
        with self._changed:
            gaps = [b - a for a, b in zip(list(self._arrivals_s)[:-1], list(self._arrivals_s)[1:], strict=True)]
            return FeedState(
                self._opened,
                self._arrivals_s[-1] if self._arrivals_s else None,
                median(gaps) if gaps and median(gaps) <= _SLOWEST_S else None,
                None if self._error is None else self._error.message,
                self._unmet,
            )

    def wait_opened(self, deadline_s: float) -> bool:
        """Waits until the camera is open or opening has failed. Returns whether the camera is open."""
        with self._changed:
            self._changed.wait_for(lambda: self._opened or self._error is not None, _left(deadline_s))
            return self._opened

    def wait_frames(self, count: int, deadline_s: float) -> bool:
        """Waits until the camera has delivered ``count`` frames since it was opened; returns False at the deadline."""
        with self._changed:
            self._changed.wait_for(lambda: self._count >= count, _left(deadline_s))
            return self._count >= count

    def want(self, from_s: float) -> None:
        """Starts to decode and store the frames that arrive after ``from_s`` (time.monotonic, s), until ``collect``
        takes a frame."""
        with self._changed:
            self._frames.clear()
            self._wanted_from_s, self._due_s = from_s, None

    def due(self, earliest_s: float) -> None:
        """Requests only the first frame that arrives at ``earliest_s`` (time.monotonic, s) or later. Frames after that
        first one are not decoded."""
        with self._changed:
            self._due_s = earliest_s

    def unwant(self) -> None:
        """Drops the stored frames, and stops decoding frames."""
        with self._changed:
            self._frames.clear()
            self._wanted_from_s = self._due_s = None

    def collect(self, earliest_s: float, deadline_s: float) -> Frame | None:
        """Returns the first stored frame that arrived at ``earliest_s`` or later, or None if no such frame arrives by
        the deadline."""

        def first() -> Frame | None:
            return next((frame for frame in self._frames if frame.time_s >= earliest_s), None)

        with self._changed:
            self._changed.wait_for(lambda: first() is not None, _left(deadline_s))
            return first()

    def trigger(self) -> None:
        """Makes the camera's thread send the software trigger."""
        self._release.set()

    def _run(self) -> None:
        while not self._stop.is_set():
            try:
                self._driver.open(self._open_timeout_s)
                unmet = self._driver.configure()
                self._note_opened(unmet)
                self._grab_until_stopped()
            except DriverError as error:
                self._note_error(error)
            except Exception as error:  # a vendor's library may raise anything; the other cameras go on
                self._note_error(
                    DriverError(
                        self.camera.name, compose("driver-failed", kind=type(error).__name__, reason=str(error))
                    )
                )
            self._driver.close()
            self._stop.wait(_REOPEN_S)

    def _grab_until_stopped(self) -> None:
        slice_s = _SOFTWARE_SLICE_S if self.camera.trigger == "software" else _SLICE_S
        while not self._stop.is_set():
            if self._release.is_set():
                self._release.clear()
                self._driver.trigger()
            with contextlib.suppress(GrabTimeout):
                self._grab(slice_s)

    def _grab(self, slice_s: float) -> None:
        arrival = self._driver.grab(slice_s)
        with self._changed:
            wanted = self._wants(arrival)
        # Decoded outside the lock: it takes milliseconds, and state() must not wait for it.
        frame = self._decode(arrival) if wanted else None
        with self._changed:
            self._count += 1
            self._arrivals_s.append(arrival.time_s)
            if frame is not None and self._wants(arrival):
                self._frames.append(frame)
            self._changed.notify_all()

    def _wants(self, arrival: Arrival) -> bool:
        if self._wanted_from_s is None or arrival.time_s < self._wanted_from_s:
            return False
        return self._due_s is None or all(frame.time_s < self._due_s for frame in self._frames)

    def _decode(self, arrival: Arrival) -> Frame | None:
        try:
            image = self._driver.retrieve()
        except CameraLost:
            raise
        except DriverError:
            return None  # one damaged frame is a dropped frame; the camera is well
        return Frame(upright(image, self.camera.rotation_deg), arrival.time_s, arrival.sequence)

    def _note_opened(self, unmet: tuple[Message, ...]) -> None:
        with self._changed:
            self._opened, self._unmet, self._error, self._count = True, unmet, None, 0
            self._arrivals_s.clear()
            self._changed.notify_all()

    def _note_error(self, error: DriverError) -> None:
        with self._changed:
            self._opened, self._error = False, error
            self._changed.notify_all()


def _left(deadline_s: float) -> float:
    return max(0.0, deadline_s - time.monotonic())
