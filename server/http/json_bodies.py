"""Guards JSON bodies: the caller is identified before the body is read, and the body's size is limited.

FastAPI reads the whole body of a route that declares one before it runs the route's dependencies, so a dependency comes
too late. Routes that read their body themselves, above all uploads, are passed through: their dependencies run first,
and they have limits of their own."""

from collections.abc import Sequence

from fastapi import Request
from fastapi.routing import APIRoute
from starlette.routing import Match
from starlette.types import ASGIApp, Message, Receive, Scope, Send

from rig.messages.message import compose
from server.http.auth import check_caller
from server.wire.patience import IDLE_TIMEOUT_S, within
from server.wire.problems import Problem, problem_from

JSON_BYTES = 4 << 20  # the largest legitimate body, feature points of all cameras, has 0.3 MB


class JsonBodies:
    """Guards the routes that take a JSON body: identifies the caller, reads the body, at most ``most`` bytes, and
    passes the request on. It answers others with a problem document: 401 or 403 for the caller, 413 for the size, 415
    for a form."""

    def __init__(
        self, app: ASGIApp, routes: Sequence[APIRoute], most: int = JSON_BYTES, body_s: float = IDLE_TIMEOUT_S
    ) -> None:
        """Wraps ``app``. ``routes`` are all of its routes in their order."""
        self._app, self._routes, self._most, self._body_s = app, routes, most, body_s

    async def __call__(self, scope: Scope, receive: Receive, send: Send) -> None:
        """Handles one ASGI connection. What is no request with a JSON body is passed on unread."""
        fitting = (route for route in self._routes if route.matches(scope)[0] is Match.FULL)
        route = next(fitting, None) if scope["type"] == "http" else None
        if route is None or route.body_field is None:
            await self._app(scope, receive, send)
            return
        try:
            request = Request(scope, receive)
            await check_caller(request)
            messages = await self._read(request)
        except Exception as error:
            scope["route"] = route  # the router did not run; log and metrics need the route
            await problem_from(error).response()(scope, receive, send)
            return

        async def receive_again() -> Message:
            return messages.pop(0) if messages else await receive()

        await self._app(scope, receive_again, send)

    async def _read(self, request: Request) -> list[Message]:
        """Returns the ASGI messages of the body, up to its end or the client's disconnection.

        Raises a 413 problem for a body that is too large, 408 for one that takes longer than ``body_s`` seconds, and
        415 for a form: that is an archive sent to the wrong address."""
        if request.headers.get("content-type", "").casefold().startswith("multipart/"):
            detail = compose("json-wanted-here")
            raise Problem(415, "unsupported-media-type", detail)
        announced = request.headers.get("content-length", "")
        self._check(int(announced) if announced.isascii() and announced.isdigit() else 0)
        messages: list[Message] = []
        received, more = 0, True
        async with within(self._body_s):
            while more:
                messages.append(message := await request.receive())
                received += len(message.get("body", b""))
                self._check(received)
                more = message["type"] == "http.request" and message.get("more_body", False)
        return messages

    def _check(self, length: int) -> None:
        if length > self._most:
            raise Problem(413, "body-too-large", compose("json-body-too-large", bytes=self._most))
