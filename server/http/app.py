"""Composes the API as an ASGI app: routers, middleware, and the tasks that run beside the requests."""

import asyncio
import hashlib
import time
from collections.abc import AsyncIterator, Callable, Sequence
from contextlib import asynccontextmanager, suppress
from functools import partial
from importlib.metadata import version
from weakref import WeakValueDictionary

import structlog
from fastapi import FastAPI
from fastapi.middleware.cors import CORSMiddleware
from fastapi.routing import APIRoute
from starlette.datastructures import Headers
from starlette.routing import Match
from starlette.types import ASGIApp, Message, Receive, Scope, Send

from rig.messages.message import compose
from server.http.auth import FairShares
from server.http.json_bodies import JsonBodies
from server.http.linger import DrainRequestBody
from server.http.openapi import CHANGES, describe, operation_name
from server.http.routes import batches, calibrations, captures, jobs, operations, rig, sessions, storage, uploads
from server.metrics import Metrics
from server.services.health import check_egl, check_store, store_places
from server.services.retention import sweep
from server.services.service import Service, open_service
from server.settings import ServiceSettings
from server.storage.store import new_id
from server.wire import problems
from server.wire.problems import Problem

LAG_EVERY_S = 0.02
BATCHES_AGAIN_S = 5.0
STORE_AGAIN_S = 10.0
EXPOSED = ("Location", "ETag", "Upload-Offset", "Upload-Length", "Upload-Expires", "Tus-Resumable", "X-Request-Id")

POLICY = (  # NiceGUI writes scripts and styles into its pages, and Vue compiles their templates by eval
    "default-src 'self'; script-src 'self' 'unsafe-inline' 'unsafe-eval' blob:; style-src 'self' 'unsafe-inline'; "
    "img-src 'self' data: blob:; font-src 'self' data:; connect-src 'self' data: blob: ws: wss:; "
    "worker-src 'self' blob:; object-src 'none'; base-uri 'self'; form-action 'self'; frame-ancestors 'none'"
)
SAFE_HEADERS = ((b"content-security-policy", POLICY.encode()), (b"x-content-type-options", b"nosniff"))

MODULES = (captures, calibrations, jobs, batches, sessions, uploads, rig, storage, operations)
MountPages = Callable[[FastAPI, ServiceSettings], None]

log = structlog.get_logger()


def create_app(settings: ServiceSettings, mount_pages: MountPages | None = None) -> FastAPI:
    """Builds the service's ASGI app. ``mount_pages`` adds the operator's pages to it. Data folder and database are
    opened when the app starts, not when this function is called."""

    @asynccontextmanager
    async def lifespan(app: FastAPI) -> AsyncIterator[None]:
        app.state.service = service = await asyncio.to_thread(open_service, settings, metrics)
        tasks = [asyncio.create_task(_look_around(service))]
        tasks += [asyncio.create_task(_sweep_forever(service)), asyncio.create_task(_measure_lag(metrics))]
        tasks += [asyncio.create_task(_serve_batches(service)), asyncio.create_task(_watch_store(service))]
        try:
            yield
        finally:
            for task in tasks:
                task.cancel()
            with suppress(asyncio.CancelledError):
                await asyncio.gather(*tasks)
            await asyncio.to_thread(service.close)

    metrics = Metrics()
    app = FastAPI(
        title="eigenhead",
        version=version("eigenhead"),
        description="One shot of a calibrated camera rig in, a textured 3D head with its uncertainty out.",
        lifespan=lifespan,
        docs_url=None,
        redoc_url=None,
        generate_unique_id_function=operation_name,
    )
    routers = [module.router for module in MODULES]
    for router in routers:
        app.include_router(router)
    routes = [route for router in routers for route in router.routes if isinstance(route, APIRoute)]
    problems.install(app, routes)
    app.add_middleware(JsonBodies, routes=routes)
    app.add_middleware(Conditions, routes=routes)
    if mount_pages is not None:
        mount_pages(app, settings)
    if settings.cors_origins:
        app.add_middleware(
            CORSMiddleware,
            allow_origins=settings.cors_origins,
            allow_methods=["*"],
            allow_headers=["*"],
            expose_headers=EXPOSED,
        )
    app.add_middleware(FairShares)
    app.add_middleware(Watch, metrics=metrics)
    app.add_middleware(DrainRequestBody)  # outside Watch, so that Watch does not time a slow client
    describe(app, settings.public_url)
    return app


class Watch:
    """Gives every request an id (header X-Request-Id) and ``SAFE_HEADERS``, logs it, and counts it in the metrics."""

    def __init__(self, app: ASGIApp, metrics: Metrics) -> None:
        self._app, self._metrics = app, metrics

    async def __call__(self, scope: Scope, receive: Receive, send: Send) -> None:
        """Handles one ASGI connection. Only HTTP requests get an id and are counted."""
        if scope["type"] != "http":
            await self._app(scope, receive, send)
            return
        request_id, began, status = new_id(), time.monotonic(), 500

        async def send_with_id(message: Message) -> None:
            nonlocal status
            if message["type"] == "http.response.start":
                status = message["status"]
                message["headers"] = [
                    *message.get("headers", []),
                    *SAFE_HEADERS,
                    (b"x-request-id", request_id.encode()),
                ]
            await send(message)

        with structlog.contextvars.bound_contextvars(request=request_id):
            try:
                await self._app(scope, receive, send_with_id)
            finally:
                route = getattr(scope.get("route"), "path", "other")
                self._metrics.observe(scope["method"], route, status, began)
                if route not in ("/healthz", "/readyz", "/metrics"):
                    ms = round((time.monotonic() - began) * 1000, 1)
                    log.info("request", method=scope["method"], path=scope["path"], status=status, ms=ms)


class Conditions:
    """Answers HEAD as GET without the content, tags the state of what can be changed (ETag), and refuses with 412 a
    change whose ``If-Match`` names another state."""

    def __init__(self, app: ASGIApp, routes: Sequence[APIRoute]) -> None:
        self._app, self._routes = app, routes
        self._locks: WeakValueDictionary[str, asyncio.Lock] = WeakValueDictionary()  # by path

    async def __call__(self, scope: Scope, receive: Receive, send: Send) -> None:
        """Handles one ASGI connection."""
        kinds = self._methods(scope) if scope["type"] == "http" else set[str]()
        method, wanted = scope.get("method"), Headers(scope=scope).get("if-match") if kinds else None
        if method == "HEAD" and "GET" in kinds and "HEAD" not in kinds:
            got = {**scope, "method": "GET"}
            await self._app(got, receive, partial(_send_start, send))
            scope["route"] = got.get("route")
        elif method == "GET" and kinds & CHANGES:
            start, content, tag = await self._state(scope, receive)
            await send({**start, "headers": [*start["headers"], *([(b"etag", tag.encode())] if tag else [])]})
            await send({"type": "http.response.body", "body": content})
        elif wanted and method in CHANGES & kinds and "GET" in kinds:
            async with self._locks.setdefault(scope["path"], asyncio.Lock()):
                *_, held = await self._state({**scope, "method": "GET"}, _no_content)
                if held and not {"*", held} & {tag.strip() for tag in wanted.split(",")}:
                    await Problem(412, "changed-since", compose("changed-since")).response()(scope, receive, send)
                else:
                    await self._app(scope, receive, send)
        else:
            await self._app(scope, receive, send)

    def _methods(self, scope: Scope) -> set[str]:
        """Returns the methods of the routes with the path of a request."""
        fitting = (route for route in self._routes if route.matches(scope)[0] is not Match.NONE)
        return {method for route in fitting for method in route.methods or ()}

    async def _state(self, scope: Scope, receive: Receive) -> tuple[Message, bytes, str]:
        """Returns the start and content of what a GET answers, and the tag of what it found, empty where nothing."""
        sent: list[Message] = []

        async def take(message: Message) -> None:
            sent.append(message)

        await self._app(scope, receive, take)
        content = b"".join(message.get("body", b"") for message in sent[1:])
        return sent[0], content, f'"{hashlib.sha256(content).hexdigest()}"' if sent[0]["status"] == 200 else ""


async def _no_content() -> Message:
    return {"type": "http.request"}


async def _send_start(send: Send, message: Message) -> None:
    """Sends the start of an answer, and that it has no content."""
    if message["type"] == "http.response.start":
        await send(message)
        await send({"type": "http.response.body"})


async def _look_around(service: Service) -> None:
    await service.threads.disk(check_egl, service)


async def _watch_store(service: Service) -> None:
    """Asks the stores every ``STORE_AGAIN_S`` seconds whether they answer, where there are any."""
    while store_places(service):
        await service.threads.disk(check_store, service)
        await asyncio.sleep(min(STORE_AGAIN_S, service.settings.sweep_s))


async def _sweep_forever(service: Service) -> None:
    """Removes expired data at once and then every ``sweep_s`` seconds. A sweep that fails is logged; the next one
    runs."""
    while True:
        try:
            await service.threads.disk(sweep, service)
        except Exception as error:  # a full or missing disk, an unreachable database
            log.error("sweep failed", error=str(error)[:300])
        await asyncio.sleep(service.settings.sweep_s)


async def _serve_batches(service: Service) -> None:
    """Queues jobs of batches every ``poll_s`` seconds. A call that fails is logged, and the next one tries again."""
    while True:
        pause_s = service.settings.poll_s
        try:
            await service.threads.disk(service.batches.serve)
        except Exception as error:  # a database that is away
            log.error("batches not served", error=str(error)[:300])
            pause_s = max(pause_s, BATCHES_AGAIN_S)
        await asyncio.sleep(pause_s)


async def _measure_lag(metrics: Metrics) -> None:
    loop = asyncio.get_running_loop()
    while True:
        began = loop.time()
        await asyncio.sleep(LAG_EVERY_S)
        metrics.lag.observe(max(0.0, loop.time() - began - LAG_EVERY_S))
