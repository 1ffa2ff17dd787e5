"""Adds the operator's pages to the service's app."""

from pathlib import Path

from fastapi import FastAPI
from nicegui import app as pages
from nicegui import ui
from nicegui.storage import Storage
from starlette.middleware.gzip import GZipMiddleware
from starlette.responses import PlainTextResponse
from starlette.routing import Match, Mount
from starlette.types import ASGIApp, Message, Receive, Scope, Send

from server.console import theme
from server.console.identity import cookie_secret, is_foreign, is_rebound
from server.settings import ServiceSettings

COOKIE_DAYS = 30
REFUSED = (
    "This page is not open to other web pages. Behind a proxy, set EIGENHEAD_PUBLIC_URL to the address you asked for."
)
PAGES = frozenset(
    [
        *("/", "/subjects", "/captures", "/features", "/jobs", "/batches", "/result", "/calibration", "/service"),
        *("/sign-in", "/favicon.ico"),
    ]
)
PACKED = ("/_nicegui/", "/console/static/")  # with the pages all that is sent by gzip: live view and events would wait
FOLDERS = ("/_nicegui", "/console/", "/features/", "/result/")


def mount_console(app: FastAPI, settings: ServiceSettings) -> None:
    """Adds the pages to the service's app, at ``/``. The HTTP API handles all addresses that are not pages.

    NiceGUI has only one app in each process. If several services run in one process, the last service has the pages.
    """
    from server.console import media  # noqa: F401 - they add their routes to NiceGUI's app
    from server.console.pages import (  # noqa: F401
        batches,
        calibration,
        captures,
        features,
        jobs,
        result,
        rig,
        service,
        sign_in,
        subjects,
    )

    Storage.path = settings.data.resolve() / "console"
    pages.state.eigenhead = app
    ui.run_with(
        app,
        title="eigenhead",
        favicon=Path(__file__).with_name("static") / "favicon.svg",
        dark=True,
        language="en-US",
        binding_refresh_interval=None,
        reconnect_timeout=10.0,
        message_history_length=200,
        gzip_middleware_factory=None,  # PagesMount packs what no live view needs
        tailwind=False,
        show_welcome_message=False,
        storage_secret=cookie_secret(settings.data),
        session_middleware_kwargs={
            "session_cookie": "eigenhead_console",
            "same_site": "strict",
            "max_age": COOKIE_DAYS * 86400,
            "https_only": (settings.public_url or "").startswith("https://"),
        },
    )
    pages.add_static_files("/console/static", Path(__file__).with_name("static"))
    mounted = app.router.routes.pop()
    assert isinstance(mounted, Mount)
    app.router.routes.append(PagesMount(mounted, settings))
    theme.install()


def path_below(scope: Scope) -> str:
    """Returns the path of a request relative to where a proxy mounts the service (``root_path`` of ASGI)."""
    path, root = scope["path"], scope.get("root_path", "")
    below = path.removeprefix(root)
    return below if below == "" or below.startswith("/") else path


def style_first(inner: ASGIApp) -> ASGIApp:
    """Returns the app with a low priority for its pages' scripts, which would otherwise delay the style sheets at 400
    kbit/s."""

    async def app(scope: Scope, receive: Receive, send: Send) -> None:
        async def ordered(message: Message) -> None:
            if message["type"] == "http.response.start":  # the page grows
                message["headers"] = [pair for pair in message["headers"] if pair[0] != b"content-length"]
            elif message["type"] == "http.response.body":
                body = message["body"].replace(b'rel="modulepreload"', b'rel="modulepreload" fetchpriority="low"')
                message = {**message, "body": body}
            await send(message)

        await inner(scope, receive, ordered if path_below(scope) in PAGES else send)

    return app


class PagesMount(Mount):
    """Serves the pages at their paths only, and refuses requests that a foreign web page made a browser send."""

    def __init__(self, mounted: Mount, settings: ServiceSettings) -> None:
        super().__init__(mounted.path, app=mounted.app)
        self._settings = settings
        self._packing = GZipMiddleware(style_first(mounted.app), minimum_size=1024, compresslevel=6)

    def matches(self, scope: Scope) -> tuple[Match, Scope]:
        """Returns Starlette's match for a request: full if its path is in ``PAGES`` or below ``FOLDERS``."""
        if scope["type"] in ("http", "websocket"):
            path = path_below(scope)
            if path not in PAGES and not path.startswith(FOLDERS):
                return Match.NONE, {}
        return super().matches(scope)

    async def handle(self, scope: Scope, receive: Receive, send: Send) -> None:
        """Serves a request, or refuses it with status 403 (a websocket with code 1008) if the request comes from a
        foreign web page."""
        if is_foreign(scope, self._settings) or is_rebound(scope, self._settings):
            if scope["type"] == "websocket":
                await send({"type": "websocket.close", "code": 1008})
            else:
                await PlainTextResponse(REFUSED, 403)(scope, receive, send)
            return
        path = path_below(scope)
        is_packed = scope["type"] == "http" and (path in PAGES or path.startswith(PACKED))
        await (self._packing if is_packed else self.app)(scope, receive, send)
