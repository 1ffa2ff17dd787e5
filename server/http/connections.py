"""Limits the cost of a connection before the caller has shown an API key: bytes and seconds of a header, the pace of a
body, the client's pace of reading, and the number of connections.

uvicorn's parser, httptools, takes quadratic time for a header in many pieces and limits neither the header's size nor
its time; the parser h11 limits only the size, and takes 139 us of CPU for a request instead of 60 us. So this module
counts bytes before the parser. A connection that exceeds a time limit is closed; a header too long gets an error.
"""

import resource
from asyncio import BaseTransport, TimerHandle, Transport
from collections import Counter
from collections.abc import Sequence
from typing import cast

from uvicorn.protocols.http.httptools_impl import HttpToolsProtocol

from rig.messages.message import compose
from server.wire.problems import Problem

HEADER_BYTES = 32 << 10  # of a request line and its fields, or of a body's trailer; nginx's default (4 x 8 KiB)
HEADER_S = 30.0  # from the first byte to the end of a header
PACE_S, PACE_BYTES = 60.0, 30_000  # a body that brings less in that time is dropped: 500 B/s, as Apache's MinRate
STALL_S = 120.0  # a client who takes nothing of an answer for so long is dropped: twice nginx's send_timeout
CONNECTIONS_MOST = 2048  # of 50 kB each, with what the kernel holds of them
DESCRIPTORS_SPARED = 256  # of the process's limit: for the database and children; each connection may send a file
PIPELINED_MOST = 16  # requests that wait behind the one that is answered


class BoundedConnection(HttpToolsProtocol):
    """Serves a connection, as uvicorn does, within the limits of this module.

    If there are too many connections, or one address has more than half of them, an idle connection is closed for a new
    one: of the address with the most connections, the connection that has waited longest for a header. If no connection
    is idle, the new connection is closed.
    """

    _timer: TimerHandle | None = None
    _stalled: TimerHandle | None = None
    _in_header = True
    _unparsed = _received = 0

    def connection_made(self, transport: BaseTransport) -> None:  # pyright: ignore[reportIncompatibleMethodOverride]
        """Accepts a new connection; if there are too many, closes an idle connection or the new one."""
        super().connection_made(cast(Transport, transport))
        self.since = self.loop.time()
        self._await_header()
        most = connections_most()
        if len(self.connections) > most // 2:
            neighbours = [one for one in self.connections if self.host and getattr(one, "host", "") == self.host]
            self._make_room(neighbours, most // 2)
            self._make_room(list(self.connections), most)

    @property
    def waits(self) -> bool:
        """Returns whether the connection is waiting for a header, with no request to be answered."""
        return self._in_header and (self.cycle is None or self.cycle.response_complete)

    def drop(self) -> None:
        """Closes the connection at once and no longer counts it."""
        self.connections.discard(self)
        self.transport.abort()

    def connection_lost(self, exc: Exception | None) -> None:
        """Cancels the timer of the connection."""
        self._set_timer(None)
        self.resume_writing()
        super().connection_lost(exc)

    def pause_writing(self) -> None:
        """Starts the timer within which the client must read part of an answer."""
        self._stalled = self.loop.call_later(STALL_S, self.drop)
        super().pause_writing()

    def resume_writing(self) -> None:
        """Stops the timer for reading an answer."""
        if self._stalled is not None:
            self._stalled.cancel()
        super().resume_writing()

    def data_received(self, data: bytes) -> None:
        """Passes bytes to the parser within the limits of header and body."""
        self._unparsed += len(data)
        self._received += len(data)
        if self._in_header and self._timer is None:
            self._await_header()
        super().data_received(data)
        if self._unparsed > HEADER_BYTES and not self.transport.is_closing():
            self._refuse(Problem(431, "header-too-large", compose("header-too-large", bytes=HEADER_BYTES)))

    def on_headers_complete(self) -> None:
        """Begins a request, and the timer within which part of its body must arrive."""
        self._in_header, self._unparsed = False, 0
        self._keep_pace()
        if len(self.pipeline) >= PIPELINED_MOST:
            raise ValueError("too many pipelined requests")  # the parser's error: answered with 400, and closed
        super().on_headers_complete()

    def on_body(self, body: bytes) -> None:
        """Receives a piece of a body."""
        self._unparsed = 0
        super().on_body(body)

    def on_message_complete(self) -> None:
        """Ends a request. The timer of the next request begins with its first byte; before, keep-alive applies."""
        self._in_header, self._unparsed, self.since = True, 0, self.loop.time()
        self._set_timer(None)
        super().on_message_complete()

    def handle_websocket_upgrade(self) -> None:
        """Ends the checks of this connection, because a WebSocket has its own pings."""
        self._set_timer(None)
        super().handle_websocket_upgrade()

    def _make_room(self, crowd: Sequence[object], most: int) -> None:
        if len(crowd) > most:
            here = [one for one in crowd if isinstance(one, BoundedConnection)]
            held = Counter(one.host for one in here)
            idle = [one for one in here if one.waits and one is not self and held[one.host] >= held[self.host]]
            min(idle, key=lambda one: (-held[one.host], one.since), default=self).drop()

    @property
    def host(self) -> str:
        """Returns the address from which the connection comes; an empty text if the address is unknown."""
        return self.client[0] if self.client else ""

    def _await_header(self) -> None:
        self._set_timer(self.loop.call_later(HEADER_S, self.drop))

    def _keep_pace(self) -> None:
        """Checks after ``PACE_S`` seconds that more of the body has arrived, unless the service did not read."""
        before = self._received

        def check() -> None:
            if self.flow.read_paused or self._received - before >= PACE_BYTES:
                self._keep_pace()
            else:
                self.drop()

        self._set_timer(self.loop.call_later(PACE_S, check))

    def _set_timer(self, timer: TimerHandle | None) -> None:
        if self._timer is not None:
            self._timer.cancel()
        self._timer = timer

    def _refuse(self, problem: Problem) -> None:
        answer = problem.response()
        fields = [*answer.raw_headers, (b"connection", b"close")]
        head = b"".join(name + b": " + value + b"\r\n" for name, value in fields)
        self.transport.write(b"HTTP/1.1 %d \r\n%b\r\n%b" % (problem.status, head, answer.body))
        self.transport.close()


def connections_most() -> int:
    """Returns how many connections may be open: at most ``CONNECTIONS_MOST``, and few enough for the process's limit of
    open files."""
    files = resource.getrlimit(resource.RLIMIT_NOFILE)[0]
    return min(CONNECTIONS_MOST, max(files - DESCRIPTORS_SPARED, files // 2) // 2)
