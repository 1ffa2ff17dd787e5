"""Gives a camera that is no real device its steady frame rate."""

import time


class Pace:
    """Ticks ``fps`` times a second from its creation on. Ticks that nobody waited for are lost, as frames of a camera
    are."""

    def __init__(self, fps: float) -> None:
        self._period_s = 1.0 / fps
        self._started_s = time.monotonic()
        self.beat = 0

    def wait(self, timeout_s: float) -> bool:
        """Sleeps until the next tick, or for ``timeout_s``. Tells whether there was a tick."""
        passed = int((time.monotonic() - self._started_s) / self._period_s)
        due = max(self.beat + 1, passed)
        wait_s = self._started_s + due * self._period_s - time.monotonic()
        if wait_s > timeout_s:
            time.sleep(timeout_s)
            return False
        time.sleep(max(0.0, wait_s))
        self.beat = due
        return True
