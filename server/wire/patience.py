"""Bodies as they come, with an end to the waiting: a client that vanished without a word sends nothing more, and would
hold its connection, and what is locked for it, for ever."""

from collections.abc import AsyncIterator

import anyio

from rig.messages.message import compose
from server.wire.problems import Problem

IDLE_TIMEOUT_S = (
    30.0  # between two pieces: above the pauses of a network that changes, below what who sends again waits for
)


async def with_idle_timeout(stream: AsyncIterator[bytes], silent_s: float) -> AsyncIterator[bytes]:
    """Yields the pieces of ``stream``. Raises a 408 problem if the next one does not come within ``silent_s``; how long
    the whole takes does not matter."""
    while (piece := await _next(stream, silent_s)) is not None:
        yield piece


async def _next(stream: AsyncIterator[bytes], silent_s: float) -> bytes | None:
    try:
        with anyio.fail_after(silent_s):
            return await anext(stream, None)
    except TimeoutError as error:
        detail = compose("body-silent", seconds=silent_s)
        raise Problem(408, "body-silent", detail, headers={"Connection": "close"}) from error
