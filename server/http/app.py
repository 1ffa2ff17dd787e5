"""Composes the API as an ASGI app: routers, middleware, background tasks, and the OpenAPI description."""

import asyncio
import hashlib
import time
from collections.abc import AsyncIterator, Callable, Iterator, Sequence
from contextlib import asynccontextmanager, suppress
from functools import partial
from importlib.metadata import version
from typing import Any
from weakref import WeakValueDictionary

import structlog
from fastapi import FastAPI, Request
from fastapi.middleware.cors import CORSMiddleware
from fastapi.routing import APIRoute
from pydantic import TypeAdapter
from starlette.datastructures import Headers
from starlette.routing import Match
from starlette.types import ASGIApp, Message, Receive, Scope, Send

from pipeline.settings import SPACING_RANGE_MM, Settings
from pipeline.warnings import WARNING_CODES
from rig.messages.message import compose
from server.http.auth import FairShares, check_caller
from server.http.routes import batches, calibrations, captures, jobs, live, operations, rig, sessions, uploads
from server.metrics import Metrics
from server.services.answer import SETTINGS
from server.services.health import check_egl, check_store, store_places
from server.services.retention import sweep
from server.services.service import Service, open_service
from server.settings import ServiceSettings
from server.storage.records import JsonObject
from server.storage.store import new_id
from server.wire import problems
from server.wire.patience import IDLE_TIMEOUT_S, within
from server.wire.problems import Problem, problem_from

LAG_EVERY_S = 0.02
BATCHES_AGAIN_S = 5.0
STORE_AGAIN_S = 10.0
EXPOSED = ("Location", "ETag", "Upload-Offset", "Upload-Length", "Upload-Expires", "Tus-Resumable", "X-Request-Id")

REFERENCE = "#/components/schemas/{model}"
CHANGES = frozenset({"PUT", "PATCH", "DELETE"})  # methods that If-Match makes conditional
TEXTUAL = ("application/json", problems.MEDIA_TYPE, "text/")
POLICY = (  # NiceGUI writes scripts and styles into its pages, and Vue compiles their templates by eval
    "default-src 'self'; script-src 'self' 'unsafe-inline' 'unsafe-eval' blob:; style-src 'self' 'unsafe-inline'; "
    "img-src 'self' data: blob:; font-src 'self' data:; connect-src 'self' data: blob: ws: wss:; "
    "worker-src 'self' blob:; object-src 'none'; base-uri 'self'; form-action 'self'; frame-ancestors 'none'"
)
SAFE_HEADERS = ((b"content-security-policy", POLICY.encode()), (b"x-content-type-options", b"nosniff"))

MODULES = (captures, calibrations, jobs, batches, sessions, uploads, rig, live, operations)
MountPages = Callable[[FastAPI, ServiceSettings], None]

log = structlog.get_logger()
JSON_BYTES = 4 << 20  # the largest legitimate body, feature points of all cameras, has 0.3 MB
PATIENCE_S = 2.0  # enough for the rest of a short upload; the sender of gigabytes is answered after that
LINGER_S = 10.0  # a proxy closes within milliseconds of a complete answer; a client that sends on gets no longer


def create_app(settings: ServiceSettings, mount_pages: MountPages | None = None) -> FastAPI:
    """Builds the service's ASGI app. ``mount_pages`` adds the operator's pages to the app. Data folder and database are
    opened when the app starts, not when this function is called."""

    @asynccontextmanager
    async def lifespan(app: FastAPI) -> AsyncIterator[None]:
        app.state.service = service = await asyncio.to_thread(open_service, settings, metrics)
        looked = min(STORE_AGAIN_S, settings.sweep_s)
        beside = [
            service.threads.disk(check_egl, service),
            _measure_lag(metrics),
            _repeat(service, partial(sweep, service), settings.sweep_s, "sweep failed"),
            _repeat(service, service.batches.serve, settings.poll_s, "batches not served", BATCHES_AGAIN_S),
        ]
        if store_places(service):
            beside.append(_repeat(service, partial(check_store, service), looked, "stores not looked at"))
        tasks = [asyncio.create_task(each) for each in beside]
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
        generate_unique_id_function=lambda route: route.name,  # generated clients name their methods so
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
        """Handles one ASGI connection; only HTTP requests get an id and are counted."""
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
    """Answers HEAD like GET without the content, adds an ETag to resources that can be changed, and refuses a change
    with 412 if its ``If-Match`` names another state of the resource."""

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
        """Returns the start and content of a GET's answer, and the resource's tag (empty if there is none)."""
        sent: list[Message] = []

        async def take(message: Message) -> None:
            sent.append(message)

        await self._app(scope, receive, take)
        content = b"".join(message.get("body", b"") for message in sent[1:])
        return sent[0], content, f'"{hashlib.sha256(content).hexdigest()}"' if sent[0]["status"] == 200 else ""


async def _no_content() -> Message:
    return {"type": "http.request"}


async def _send_start(send: Send, message: Message) -> None:
    """Sends the start of an answer without content."""
    if message["type"] == "http.response.start":
        await send(message)
        await send({"type": "http.response.body"})


async def _repeat(
    service: Service, action: Callable[[], object], every_s: float, fault: str, again_s: float = 0.0
) -> None:
    """Runs an action in a thread at once and every ``every_s`` seconds. An action that fails, for example because the
    disk is full or the database unreachable, is logged as ``fault`` and repeated after ``again_s`` or more."""
    while True:
        pause_s = every_s
        try:
            await service.threads.disk(action)
        except Exception as error:
            log.error(fault, error=str(error)[:300])
            pause_s = max(pause_s, again_s)
        await asyncio.sleep(pause_s)


async def _measure_lag(metrics: Metrics) -> None:
    loop = asyncio.get_running_loop()
    while True:
        began = loop.time()
        await asyncio.sleep(LAG_EVERY_S)
        metrics.lag.observe(max(0.0, loop.time() - began - LAG_EVERY_S))


class JsonBodies:
    """Guards the routes that take a JSON body: identifies the caller, reads at most ``most`` bytes of the body, and
    passes the request on. The class answers bad requests with a problem document: 401 or 403 for the caller, 413 for
    the size, 415 for a form.

    A FastAPI dependency would check the caller too late, because FastAPI reads a JSON body before it runs dependencies.
    Requests to routes that read the body themselves, mainly uploads, are passed through: these routes run their
    dependencies first, and have limits of their own."""

    def __init__(
        self, app: ASGIApp, routes: Sequence[APIRoute], most: int = JSON_BYTES, body_s: float = IDLE_TIMEOUT_S
    ) -> None:
        """Wraps ``app``. ``routes`` are all routes of the app in their order."""
        self._app, self._routes, self._most, self._body_s = app, routes, most, body_s

    async def __call__(self, scope: Scope, receive: Receive, send: Send) -> None:
        """Handles one ASGI connection. A request without a JSON body is passed on unread."""
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
        415 for a form, which is an archive sent to the wrong address."""
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


class DrainRequestBody:
    """Reads and drops the rest of a request's body when the connection will be closed after the answer.

    The answer begins once the body has ended or after ``patience_s`` seconds, and ends once the body has ended or after
    another ``linger_s`` seconds.

    uvicorn closes a connection that is not kept alive as soon as the answer is sent. Bytes that arrive after the
    connection was closed reset it, and a sender such as nginx loses the answer: its client saw 502 in place of 401 or
    422. So this class reads and drops the remaining bytes before the answer ends, as nginx's own lingering_close does.
    The class drops the rest of a short upload before the answer begins: if an answer overtakes the body, nginx closes
    its client's kept-alive connection, and the client's next request fails.
    """

    def __init__(self, app: ASGIApp, *, patience_s: float = PATIENCE_S, linger_s: float = LINGER_S) -> None:
        self._app, self._patience_s, self._linger_s = app, patience_s, linger_s

    async def __call__(self, scope: Scope, receive: Receive, send: Send) -> None:
        """Handles one ASGI connection. Requests whose connection is kept alive are passed on unchanged."""
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


def describe(app: FastAPI, address: str | None) -> None:
    """Replaces ``app.openapi`` by a function that returns the completed OpenAPI document: the pipeline's settings get
    their own schemas, files are marked as bytes, and problem documents replace the framework's errors. ``address`` is
    the service's public address; if it is None, the address of the request is used."""
    original = app.openapi

    def openapi() -> JsonObject:
        if app.openapi_schema is None:
            document = original()
            _name_problems(document)
            _name_settings(document)
            _mark_files(document)
            _name_conditions(document)
            document["servers"] = [{"url": address or "/"}]
        return app.openapi_schema or {}

    app.openapi = openapi


def _responses(document: JsonObject) -> Iterator[tuple[str, dict[str, Any]]]:
    for path in document["paths"].values():
        for call in path.values():
            yield from call.get("responses", {}).items()


def _name_problems(document: JsonObject) -> None:
    """Replaces the framework's error schemas by the schema of the problem document."""
    schemas = document.setdefault("components", {}).setdefault("schemas", {})
    schemas["Problem"] = problems.PROBLEM_SCHEMA
    for unused in ("HTTPValidationError", "ValidationError"):
        schemas.pop(unused, None)
    for status, answer in _responses(document):
        if status[0] in "45" and problems.MEDIA_TYPE in answer.get("content", {}):
            answer["content"] = {problems.MEDIA_TYPE: answer["content"][problems.MEDIA_TYPE]}


def _name_conditions(document: JsonObject) -> None:
    """Adds ``If-Match`` to the requests that change or remove a resource, and ``ETag`` to requests that get one."""
    text = {"schema": {"type": "string"}}
    tag = {"description": "of this state; If-Match takes it", **text}
    for path in document["paths"].values():
        changes = [call for method, call in path.items() if method.upper() in CHANGES]
        if not changes or "get" not in path:
            continue
        path["get"]["responses"]["200"]["headers"] = {"ETag": tag}
        for call in changes:
            meaning = "the ETag of the state that is meant to be changed: 412 if it is another by now"
            parameters = call.setdefault("parameters", [])
            parameters.append({"name": "If-Match", "in": "header", "required": False, "description": meaning, **text})
            call["responses"] |= {"412": {**call["responses"]["422"], "description": "Precondition Failed"}}


def _name_settings(document: JsonObject) -> None:
    """Adds the pipeline's settings as named schemas: every key is optional, unknown keys are refused."""
    described = TypeAdapter(Settings).json_schema(ref_template=REFERENCE)
    named = described.pop("$defs") | {"Settings": described}
    del described["properties"]["warnings"]  # of the reader
    for schema in named.values():
        schema["additionalProperties"] = False
    named["Settings"]["properties"]["fail_on"]["items"] = {"type": "string", "enum": list(WARNING_CODES)}
    least, most = SPACING_RANGE_MM
    named["BustSettings"]["properties"]["spacing_mm"] |= {"minimum": least, "maximum": most}
    _replace(document, SETTINGS, {"$ref": REFERENCE.format(model="Settings")})
    document["components"]["schemas"] |= named


def _replace(node: Any, old: JsonObject, new: JsonObject) -> None:
    for key, value in node.items() if isinstance(node, dict) else enumerate(node) if isinstance(node, list) else ():
        if isinstance(value, dict) and old.items() <= value.items():
            node[key] = {**{k: v for k, v in value.items() if k not in old}, **new}
        else:
            _replace(value, old, new)


def _mark_files(document: JsonObject) -> None:
    for _, answer in _responses(document):
        for media, content in answer.get("content", {}).items():
            if not media.startswith(TEXTUAL):
                content["schema"] = {"type": "string", "format": "binary"}
