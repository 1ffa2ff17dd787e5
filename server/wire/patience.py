"""Limits the pause between two pieces of a request's body. A vanished client sends nothing more, and would otherwise
keep its connection and its locks for ever."""

from collections.abc import AsyncIterator
from contextlib import asynccontextmanager

import anyio
from starlette.types import Receive

from rig.messages.message import compose
from server.wire.problems import Problem

IDLE_TIMEOUT_S = 30.0  # between two pieces: longer than a change of networks takes, shorter than clients wait before a
# retry


async def with_idle_timeout(stream: AsyncIterator[bytes], silent_s: float) -> AsyncIterator[bytes]:
    """Yields the pieces of ``stream``. Raises a 408 problem if a piece does not arrive within ``silent_s`` seconds. The
    total time of a request is not limited."""
    while True:
        async with within(silent_s):
            piece = await anext(stream, None)
        if piece is None:
            return
        yield piece


@asynccontextmanager
async def within(seconds: float) -> AsyncIterator[None]:
    """Raises a 408 problem if the block takes longer than ``seconds``."""
    try:
        with anyio.fail_after(seconds):
            yield
    except TimeoutError as error:
        detail = compose("body-silent", seconds=seconds)
        raise Problem(408, "body-silent", detail, headers={"Connection": "close"}) from error


async def await_hang_up(receive: Receive) -> None:
    """Returns once the client of a request whose body was read has closed the connection."""
    while (await receive())["type"] != "http.disconnect":
        pass
