"""Thread pools of bounded size, for what blocks."""

from collections.abc import Callable
from typing import Any, TypeVar

import anyio
import anyio.to_thread

T = TypeVar("T")


class Threads:
    """Runs blocking functions in thread pools apart from the web framework's, so that fifty waiting uploads do not
    delay a status request."""

    def __init__(self, disk: int = 8, checks: int = 2) -> None:
        self._disk, self._checks = anyio.CapacityLimiter(disk), anyio.CapacityLimiter(checks)

    async def disk(self, function: Callable[..., T], *arguments: Any) -> T:
        return await anyio.to_thread.run_sync(function, *arguments, limiter=self._disk)

    async def check(self, function: Callable[..., T], *arguments: Any) -> T:
        return await anyio.to_thread.run_sync(function, *arguments, limiter=self._checks)
