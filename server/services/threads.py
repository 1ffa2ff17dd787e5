"""Runs blocking functions in thread pools of bounded size."""

import asyncio
import threading
import time
from collections import Counter
from collections.abc import Awaitable, Callable
from typing import Any, TypeVar

import anyio
import anyio.to_thread

from rig.errors import Cancelled
from rig.messages.message import compose
from server.errors import Conflict, DiskFull, InvalidInput, TooMany
from server.services.keys import LOCAL
from server.tasks.child import CALLER, CANCELLED, WorkFailed

T = TypeVar("T")

IN_LINE_MOST = 64  # checks of one key that run or wait: a console sends a folder of captures at once
AGAIN_S = 30  # Retry-After of one that is refused


class Threads:
    """Runs blocking functions in two thread pools separate from the web framework's. With separate pools, fifty waiting
    uploads do not delay a request for a job's status.

    ``checks``: number of checks at once (one key may use all but one); ``check_s``: longest duration of one.
    """

    def __init__(self, disk: int = 8, checks: int = 2, check_s: float = 900.0) -> None:
        self._disk, self._checks, self._check_s = anyio.CapacityLimiter(disk), anyio.CapacityLimiter(checks), check_s
        self._shares: dict[str, anyio.CapacityLimiter] = {}
        self._in_line = Counter[str]()

    async def disk(self, function: Callable[..., T], *arguments: Any) -> T:
        """Runs a function that reads or writes files in a thread and returns its result. At most ``disk`` such
        functions run at once; others wait."""
        return await anyio.to_thread.run_sync(function, *arguments, limiter=self._disk)

    async def check(
        self,
        function: Callable[..., T],
        *arguments: Any,
        key: str,
        hung_up: Callable[[], Awaitable[None]] | None = None,
    ) -> T:
        """Runs a function that unpacks or checks an upload in a thread and returns its result. The function's work in
        child processes ends after ``check_s`` seconds, or once ``hung_up()`` has returned (the client is gone).

        At most ``checks`` such functions run at once; others wait. Raises TooMany if too many requests of API key
        ``key`` wait, InvalidInput if time or memory does not suffice, and Conflict if the client has disconnected.
        """
        if self._in_line[key] >= IN_LINE_MOST:
            raise TooMany("too-many-checks", compose("too-many-checks", most=IN_LINE_MOST), retry_after_s=AGAIN_S)
        gone = threading.Event()
        watching = None if hung_up is None else asyncio.ensure_future(hung_up())
        if watching is not None:
            watching.add_done_callback(lambda _: gone.set())
        self._in_line[key] += 1
        try:
            async with self._share(key):
                return await anyio.to_thread.run_sync(
                    self._checked, gone, key, function, *arguments, limiter=self._checks
                )
        finally:
            self._in_line[key] -= 1
            if watching is not None:
                watching.cancel()

    def _share(self, key: str) -> anyio.CapacityLimiter:
        most = self._checks.total_tokens
        return self._shares.setdefault(key, anyio.CapacityLimiter(most if key == LOCAL else max(1, most - 1)))

    def _checked(self, gone: threading.Event, key: str, function: Callable[..., T], *arguments: Any) -> T:
        deadline = time.monotonic() + self._check_s
        CALLER.set(key)  # both of this call alone: a thread's own context
        CANCELLED.set(lambda: gone.is_set() or time.monotonic() > deadline)
        try:
            if gone.is_set():  # while it waited
                raise Cancelled
            return function(*arguments)
        except Cancelled:
            if gone.is_set():
                raise Conflict("client-gone", compose("client-gone")) from None
            raise InvalidInput("check-too-long", compose("check-too-long", seconds=self._check_s)) from None
        except WorkFailed as failure:
            if failure.kind == "disk-full":
                raise DiskFull from failure
            if failure.kind not in ("out-of-memory", "killed", "crash"):  # native code may die where memory is refused
                raise
            raise InvalidInput("check-out-of-memory", compose("check-out-of-memory")) from failure
