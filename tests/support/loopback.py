"""Servers on the loopback that stand for what is elsewhere: a studio's program, a store, a package index."""

import json
import threading
from collections.abc import Iterator
from contextlib import contextmanager, suppress
from dataclasses import dataclass, field
from functools import partial
from http.server import BaseHTTPRequestHandler, ThreadingHTTPServer
from pathlib import Path
from typing import Any


@contextmanager
def served(handler: type[BaseHTTPRequestHandler], folder: Path | None = None) -> Iterator[str]:
    """The address of a server that answers by ``handler``, of ``folder`` where that reads one, and logs nothing."""

    class Quiet(handler):
        def handle(self) -> None:
            with suppress(OSError):  # whoever asked went away
                super().handle()

        def log_message(self, format: str, *args: object) -> None:
            pass

    named: dict[str, Any] = {"directory": str(folder)} if folder else {}
    server = ThreadingHTTPServer(("127.0.0.1", 0), partial(Quiet, **named))
    server.daemon_threads = True
    threading.Thread(target=server.serve_forever, daemon=True).start()
    try:
        yield f"http://127.0.0.1:{server.server_port}"
    finally:
        server.shutdown()
        server.server_close()


@dataclass
class Hook:
    """A studio's program that is called when something ends; what it was sent has its headers in lower case."""

    url: str = ""
    received: list[tuple[dict[str, str], bytes]] = field(default_factory=list)

    def data_of(self, kind: str, job: str | None = None) -> list[dict[str, Any]]:
        """The data of the messages of that type, of one job or of all."""
        messages = [json.loads(body) for _, body in self.received]
        return [m["data"] for m in messages if m["type"] == kind and job in (None, m["data"].get("job_id"))]


@contextmanager
def hooked(fails_first: bool = False, base: type[BaseHTTPRequestHandler] = BaseHTTPRequestHandler) -> Iterator[Hook]:
    """A hook that answers 204, to the first message 500 on request; to other methods it answers as ``base`` does."""
    hook = Hook()

    class Receiver(base):
        def do_POST(self) -> None:
            body = self.rfile.read(int(self.headers["content-length"]))
            hook.received.append(({k.lower(): v for k, v in self.headers.items()}, body))
            self.send_response(500 if fails_first and len(hook.received) == 1 else 204)
            self.end_headers()

    with served(Receiver) as hook.url:
        yield hook
