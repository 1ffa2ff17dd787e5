"""Runs blocking functions in thread pools of bounded size."""

from collections.abc import Callable
from typing import Any, TypeVar

import anyio
import anyio.to_thread

T = TypeVar("T")


class Threads:
    """Runs blocking functions in two thread pools apart from the web framework's. Fifty waiting uploads then do not
    delay a request for a job's status."""

    def __init__(self, disk: int = 8, checks: int = 2) -> None:
        self._disk, self._checks = anyio.CapacityLimiter(disk), anyio.CapacityLimiter(checks)

    async def disk(self, function: Callable[..., T], *arguments: Any) -> T:
        """Runs a function that reads or writes files in a thread and returns its result. At most ``disk`` run at once;
        others wait."""
        return await anyio.to_thread.run_sync(function, *arguments, limiter=self._disk)

    async def check(self, function: Callable[..., T], *arguments: Any) -> T:
        """Runs a function that unpacks or checks an upload in a thread and returns its result. At most ``checks`` run
        at once; others wait."""
        return await anyio.to_thread.run_sync(function, *arguments, limiter=self._checks)
