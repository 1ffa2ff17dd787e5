"""Removing with undo: a capture is out of sight at once and really removed a little later, unless it is taken back.

The wait is kept in the process: if the service dies meanwhile, the capture is there again, which is the safe side.
"""

import threading
import time
from collections.abc import Callable
from dataclasses import dataclass, field

import structlog

UNDO_S = 10.0

log = structlog.get_logger()


@dataclass
class Removals:
    """What waits to be removed, by id: when, and the timer that does it."""

    wait_s: float = UNDO_S
    _waiting: dict[str, tuple[float, threading.Timer]] = field(default_factory=dict)
    _lock: threading.Lock = field(default_factory=threading.Lock)

    def add(self, identity: str, remove: Callable[[], None]) -> None:
        timer = threading.Timer(self.wait_s, self._remove, (identity, remove))
        timer.daemon = True
        with self._lock:
            if identity not in self._waiting:
                self._waiting[identity] = (time.monotonic() + self.wait_s, timer)
                timer.start()

    def undo(self, identity: str) -> bool:
        """Whether it was still there to be taken back."""
        with self._lock:
            _, timer = self._waiting.pop(identity, (0.0, None))
        if timer is not None:
            timer.cancel()
        return timer is not None

    def remaining_s(self) -> dict[str, float]:
        with self._lock:
            return {identity: max(0.0, at - time.monotonic()) for identity, (at, _) in self._waiting.items()}

    def _remove(self, identity: str, remove: Callable[[], None]) -> None:
        with self._lock:
            if identity not in self._waiting:
                return
        try:
            remove()
        except Exception as error:  # it is shown again, with the reason in the log
            log.warning("not removed", id=identity, error=str(error))
        with self._lock:
            self._waiting.pop(identity, None)
