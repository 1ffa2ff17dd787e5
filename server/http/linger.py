"""A refused upload's answer must reach who is still sending it.

uvicorn closes a connection that is not kept alive as soon as the answer is out. Bytes that arrive after that reset it,
and whoever was writing them, nginx above all, loses the answer: its client saw 502 in place of 401 or 422. So what is
still coming is read and dropped before the answer ends, as nginx's own lingering_close does. A short upload is
dropped before the answer begins: nginx ends its client's connection too where an answer overtakes the body, after it
has promised to keep it, and the client's next request fails.
"""

import asyncio
from contextlib import suppress

from starlette.types import ASGIApp, Message, Receive, Scope, Send

PATIENCE_S = 2.0  # the rest of a short upload; who sends gigabytes shall hear sooner that they are not wanted
LINGER_S = 10.0  # a proxy hangs up within milliseconds of a whole answer; a client that sends on gets no longer


class DrainRequestBody:
    """Answers a request whose body was not read, on a connection that closes, once no more of it comes, or after
    ``patience_s``; then ends the answer once no more comes, or after ``linger_s``."""

    def __init__(self, app: ASGIApp, *, patience_s: float = PATIENCE_S, linger_s: float = LINGER_S) -> None:
        self._app, self._patience_s, self._linger_s = app, patience_s, linger_s

    async def __call__(self, scope: Scope, receive: Receive, send: Send) -> None:
        if scope["type"] != "http" or not _closes(scope):
            await self._app(scope, receive, send)
            return
        coming, held = _has_body(scope), False

        async def receive_noting() -> Message:
            nonlocal coming
            message = await receive()
            coming = message["type"] == "http.request" and message.get("more_body", False)
            return message

        async def drop_for(seconds: float) -> None:
            with suppress(TimeoutError):
                async with asyncio.timeout(seconds):
                    while coming:
                        await receive_noting()

        async def send_holding(message: Message) -> None:
            nonlocal held
            if message["type"] == "http.response.start":
                await drop_for(self._patience_s)
            held = coming and message["type"] == "http.response.body" and not message.get("more_body", False)
            await send({**message, "more_body": True} if held else message)

        await self._app(scope, receive_noting, send_holding)
        if held:
            await drop_for(self._linger_s)
            await send({"type": "http.response.body"})


def _closes(scope: Scope) -> bool:
    connection = b",".join(value for name, value in scope["headers"] if name == b"connection").lower()
    return b"close" in connection or (scope["http_version"] == "1.0" and b"keep-alive" not in connection)


def _has_body(scope: Scope) -> bool:
    names = {name: value for name, value in scope["headers"]}
    return b"transfer-encoding" in names or names.get(b"content-length", b"0") != b"0"
