"""Thread pools of bounded size, for what blocks."""

from collections.abc import Callable
from typing import Any, TypeVar

import anyio
import anyio.to_thread

T = TypeVar("T")


class Threads:
    """Pools apart from the one that the web framework's handlers use, so that fifty uploads that wait for their turn do
    not keep a status request waiting."""

    def __init__(self, disk: int = 8, checks: int = 2) -> None:
        self._disk, self._checks = anyio.CapacityLimiter(disk), anyio.CapacityLimiter(checks)

    async def disk(self, function: Callable[..., T], *arguments: Any) -> T:
        return await anyio.to_thread.run_sync(function, *arguments, limiter=self._disk)

    async def check(self, function: Callable[..., T], *arguments: Any) -> T:
        return await anyio.to_thread.run_sync(function, *arguments, limiter=self._checks)
