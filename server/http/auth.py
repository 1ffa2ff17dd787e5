"""Identifies the caller of a request by the API key in its Authorization header.

On a loopback address, while no key exists, everybody on this machine is a caller with all scopes. While no key exists,
requests that a foreign web page makes a browser send are refused by their Host and Origin headers.
"""

import asyncio
import hashlib
from collections.abc import Callable
from typing import Annotated
from weakref import WeakValueDictionary

from fastapi import Depends, Request
from fastapi.concurrency import run_in_threadpool
from fastapi.security import HTTPAuthorizationCredentials, HTTPBearer
from starlette.types import ASGIApp, Message, Receive, Scope, Send

from rig.messages.message import compose
from server.address import is_loopback
from server.http.connections import connections_most
from server.services.keys import LOCAL, SCOPES, Caller
from server.services.service import Service
from server.wire.problems import Problem

SLOW_S, SLOW_MOST = 0.1, 8  # what takes longer, as a shot of the rig does, makes room for so many beside it
SHARE = 4  # a caller may hold one in so many connections with answers that go on and long bodies
SMALL_DIGITS = 5  # of a body's length in bytes; a longer one takes its client's time, not the service's

bearer = HTTPBearer(auto_error=False, description="API key, eh_...; not needed on loopback while no key exists")


def service_of(request: Request) -> Service:
    """Returns the service to whose app a request was sent."""
    return request.app.state.service


ServiceOf = Annotated[Service, Depends(service_of)]


def require(scope: str) -> Callable[..., Caller]:
    """Returns a FastAPI dependency that yields the caller, or raises a 401 problem for an unknown caller and a 403
    problem for a caller without ``scope``.

    The dependency runs before an upload is read. FastAPI reads JSON bodies before it runs dependencies, so
    ``check_caller`` (in ``JsonBodies`` of server.http.app) guards the routes with a JSON body.
    """

    def authenticate(
        request: Request, credentials: Annotated[HTTPAuthorizationCredentials | None, Depends(bearer)]
    ) -> Caller:
        caller = _caller(request, credentials)
        caller.check_may(scope)
        return caller

    return authenticate


Reader = Annotated[Caller, Depends(require("read"))]
Taker = Annotated[Caller, Depends(require("capture"))]
Submitter = Annotated[Caller, Depends(require("submit"))]
Eraser = Annotated[Caller, Depends(require("erase"))]
Admin = Annotated[Caller, Depends(require("admin"))]


async def check_caller(request: Request) -> None:
    """Raises a 401 or 403 problem if the caller cannot be identified. Scopes are not checked."""
    await run_in_threadpool(_caller, request, await bearer(request))


def _caller(request: Request, credentials: HTTPAuthorizationCredentials | None) -> Caller:
    service = service_of(request)
    if credentials is not None:
        caller = service.keys.caller(credentials.credentials)
        if caller is not None:
            request.scope["caller"] = caller.key
            return caller
        detail = compose("key-unknown")
        raise Problem(401, "key-invalid", detail, headers={"WWW-Authenticate": 'Bearer error="invalid_token"'})
    if service.settings.is_private and not service.keys.any():
        _check_origin(request)
        return Caller(LOCAL, frozenset(SCOPES))
    detail = compose("key-wanted")
    raise Problem(401, "key-missing", detail, headers={"WWW-Authenticate": "Bearer"})


def _check_origin(request: Request) -> None:
    """Raises a 403 problem for a request that a foreign web page sends through a local browser (CSRF, DNS
    rebinding)."""
    origin = request.headers.get("origin")
    names = [request.url.hostname or ""]
    if origin is not None:
        names.append(origin.partition("://")[2].rpartition(":")[0] or origin.partition("://")[2])
    if not all(is_loopback(name) for name in names):
        detail = compose("foreign-origin")
        raise Problem(403, "foreign-origin", detail)


class FairShares:
    """Serves the requests of each caller one by one, so that thousands of requests delay another caller by only one.
    Parallel requests would be slower, because of Python's lock: 2,000 requests took 13.1 s in pairs and 7.8 s singly.

    A caller is identified by the network address until an API key was accepted, and by this key afterwards. A caller's
    next request begins when the answer to the previous request begins, when the previous request waits for a long body,
    or after ``SLOW_S`` seconds if fewer than ``SLOW_MOST`` requests were that slow. A caller whose streams, slow
    downloads and uploads use the fraction ``SHARE`` of all connections gets no further connection (429).
    """

    def __init__(self, app: ASGIApp) -> None:
        self._app = app
        self._known: dict[bytes, str] = {}  # by the digest of the header that was accepted
        self._lines: WeakValueDictionary[str, _Line] = WeakValueDictionary()

    async def __call__(self, scope: Scope, receive: Receive, send: Send) -> None:
        """Handles one ASGI connection. Passes on requests that are not for the API."""
        if scope["type"] != "http" or not scope["path"].startswith("/v1/"):
            await self._app(scope, receive, send)
            return
        headers = dict(scope["headers"])
        shown = hashlib.sha256(b" ".join(headers.get(b"authorization", b"").split()[1:])).digest()
        name = self._known.get(shown) or f"at {(scope.get('client') or ('',))[0]}"
        line = self._lines.setdefault(name, _Line())
        long_body = b"transfer-encoding" in headers or len(headers.get(b"content-length", b"")) > SMALL_DIGITS
        held = slow = False

        def leave() -> None:
            nonlocal held
            if held:
                held = False
                line.under_way += 1
                line.release()

        def make_room() -> None:
            nonlocal slow
            if held and line.slow < SLOW_MOST:
                slow = True
                line.slow += 1
                leave()

        async def receive_body() -> Message:
            if long_body:
                leave()
            return await receive()

        async def begin_answer(message: Message) -> None:
            if "caller" in scope:
                self._known[shown] = scope["caller"]
            leave()
            await send(message)

        await line.acquire()
        held, timer = True, asyncio.get_running_loop().call_later(SLOW_S, make_room)
        most = connections_most() // SHARE
        try:
            if line.under_way >= most:
                detail, again = compose("too-many-under-way", most=most), {"Retry-After": "5"}
                refusal = Problem(429, "too-many-requests", detail, headers=again)
                await refusal.response()(scope, receive, begin_answer)
            else:
                await self._app(scope, receive_body, begin_answer)
        finally:
            timer.cancel()
            leave()
            line.under_way -= 1
            line.slow -= slow


class _Line(asyncio.Lock):
    slow = 0  # requests that made room
    under_way = 0  # requests that left the line and have not ended
