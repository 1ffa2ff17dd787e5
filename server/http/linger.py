"""Delivers the answer of a refused upload to a client that is still sending.

uvicorn closes a connection that is not kept alive as soon as the answer is sent. Bytes that arrive afterwards reset the
connection, and a sender such as nginx loses the answer: its client saw 502 in place of 401 or 422. So the remaining
bytes are read and dropped before the answer ends, as nginx's own lingering_close does. The rest of a short upload is
dropped before the answer begins: where an answer overtakes the body, nginx closes the connection to its client although
it promised to keep it, and the client's next request fails."""

import asyncio
from contextlib import suppress

from starlette.types import ASGIApp, Message, Receive, Scope, Send

PATIENCE_S = 2.0  # enough for the rest of a short upload; the sender of gigabytes is answered after that
LINGER_S = 10.0  # a proxy closes within milliseconds of a complete answer; a client that sends on gets no longer


class DrainRequestBody:
    """Reads and drops the rest of a request's body when the connection will be closed after the answer.

    The answer begins once the body has ended or after ``patience_s`` seconds. It ends once the body has ended or after
    another ``linger_s`` seconds.
    """

    def __init__(self, app: ASGIApp, *, patience_s: float = PATIENCE_S, linger_s: float = LINGER_S) -> None:
        self._app, self._patience_s, self._linger_s = app, patience_s, linger_s

    async def __call__(self, scope: Scope, receive: Receive, send: Send) -> None:
        """Handles one ASGI connection. What is no HTTP request, or will be kept alive, is passed on as it is."""
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
