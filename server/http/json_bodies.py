"""JSON bodies: who sends one is asked first, and no more of it is taken than such a body may have.

FastAPI reads the body of a route that declares one whole, before it asks the route's dependencies. Routes that read
their body themselves, uploads above all, are let through: their dependencies come first, and they have other limits.
"""

from collections.abc import Sequence

from fastapi import Request
from fastapi.routing import APIRoute
from starlette.routing import Match
from starlette.types import ASGIApp, Message, Receive, Scope, Send

from rig.messages.message import compose
from server.http.auth import check_caller
from server.wire.problems import Problem, problem_from

JSON_BYTES = 4 << 20  # the largest that is honest, feature points of all cameras, has 0.3 MB


class JsonBodies:
    """Reads the JSON body of a request whose caller is known, up to ``most`` bytes, and hands it on; refuses others."""

    def __init__(self, app: ASGIApp, routes: Sequence[APIRoute], most: int = JSON_BYTES) -> None:
        """``routes``: all that the app has, in their order."""
        self._app, self._routes, self._most = app, routes, most

    async def __call__(self, scope: Scope, receive: Receive, send: Send) -> None:
        route = self._route(scope) if scope["type"] == "http" else None
        if route is None or route.body_field is None:
            await self._app(scope, receive, send)
            return
        try:
            request = Request(scope, receive)
            await check_caller(request)
            messages = await self._read(request)
        except Exception as error:
            scope["route"] = route  # as the router would have said, for the log and the metrics
            await problem_from(error).response()(scope, receive, send)
            return

        async def receive_again() -> Message:
            return messages.pop(0) if messages else await receive()

        await self._app(scope, receive_again, send)

    def _route(self, scope: Scope) -> APIRoute | None:
        return next((route for route in self._routes if route.matches(scope)[0] is Match.FULL), None)

    async def _read(self, request: Request) -> list[Message]:
        """The messages of the body, to its end or to where the client went away. Raises a 413 problem, and 415 for a
        form, which is an archive at the wrong address."""
        if request.headers.get("content-type", "").casefold().startswith("multipart/"):
            detail = compose("json-wanted-here")
            raise Problem(415, "unsupported-media-type", detail)
        announced = request.headers.get("content-length", "")
        self._check(int(announced) if announced.isascii() and announced.isdigit() else 0)
        messages: list[Message] = []
        received, more = 0, True
        while more:
            messages.append(message := await request.receive())
            received += len(message.get("body", b""))
            self._check(received)
            more = message["type"] == "http.request" and message.get("more_body", False)
        return messages

    def _check(self, length: int) -> None:
        if length > self._most:
            raise Problem(413, "body-too-large", compose("json-body-too-large", bytes=self._most))
