"""Serves the cameras of the simulated studio as motion-JPEG streams on one HTTP port (on loopback by default).

A stream behaves like a network camera with a trigger input. A camera's live view at ``fps`` pauses while the trigger
box is armed. When a trigger input rises, the stream sends one frame at once and then continues the live view. A
``Film`` holds a camera's pictures, which differ in their noise: some for the live view, others for triggered frames.

Only the server's event loop changes the state; other threads pass it functions to call (``call_soon_threadsafe``).
"""

import asyncio
import threading
import time
from collections.abc import Callable, Coroutine, Mapping, Sequence
from dataclasses import dataclass, field
from typing import Any
from urllib.parse import parse_qs, urlsplit

_HEAD = (
    b"HTTP/1.0 200 OK\r\nCache-Control: no-store\r\nConnection: close\r\n"
    b"Content-Type: multipart/x-mixed-replace; boundary=frame\r\n\r\n"
)
_LINE_MOST = 8192

Control = Callable[[str, str, Mapping[str, str]], tuple[int, str]]
"""Answers what is no stream: method, path and query to status and text."""


@dataclass(frozen=True, slots=True)
class Film:
    """Holds JPEG files of one scene by one camera: some for the live view, others for triggered frames."""

    live: tuple[bytes, ...]
    released: tuple[bytes, ...]


@dataclass(slots=True, eq=False)
class _Camera:
    name: str
    film: Film | None = None
    shown: bytes = b""
    frames: int = 0  # sent so far
    ticks: int = 0  # of them live ones
    releases: int = 0  # and triggered ones
    frozen: bool = False
    hung: bool = False
    held: bool = False  # armed: no live view until the input is raised
    drop_next: bool = False
    shown_event: asyncio.Event = field(default_factory=asyncio.Event)
    tick: asyncio.TimerHandle | None = None


class StreamServer:
    """Serves ``/<camera>.mjpeg`` for every camera during a ``with`` block. ``close`` leaves no thread and no port
    behind."""

    def __init__(
        self, names: Sequence[str], control: Control, *, fps: float = 5.0, host: str = "127.0.0.1", port: int = 0
    ) -> None:
        self._cameras = {name: _Camera(name) for name in names}
        self._views = {name: name for name in names}  # whose picture a stream shows: cables
        self._control = control
        self._period_s = 1.0 / fps
        self._host = host
        self._loop = asyncio.new_event_loop()
        self._clients: set[asyncio.Task[None]] = set()
        self._closed = False
        self._server = self._loop.run_until_complete(asyncio.start_server(self._serve, host, port, limit=_LINE_MOST))
        self.port: int = self._server.sockets[0].getsockname()[1]
        for index, camera in enumerate(self._cameras.values()):
            # phases spread over the period, as those of free-running cameras are
            camera.tick = self._loop.call_later(self._period_s * (index + 1) / len(names), self._tick, camera)
        self._thread = threading.Thread(target=self._loop.run_forever, name="studio streams", daemon=True)
        self._thread.start()

    def __enter__(self) -> "StreamServer":
        return self

    def __exit__(self, *_: object) -> None:
        self.close()

    @property
    def address(self) -> str:
        """Returns the beginning of the server's URLs."""
        return f"http://{self._host}:{self.port}"

    def url(self, name: str) -> str:
        """Returns the URL of a camera's stream."""
        return f"{self.address}/{name}.mjpeg"

    def close(self) -> None:
        """Ends the server's connections, port and thread. The call may be repeated."""
        if self._closed:
            return
        self._closed = True
        self._run(self._shut_down())
        self._loop.call_soon_threadsafe(self._loop.stop)
        self._thread.join()
        self._loop.run_until_complete(self._loop.shutdown_default_executor())
        self._loop.close()

    def show(self, name: str, film: Film) -> None:
        """Replaces a camera's pictures."""
        self._do(lambda: setattr(self._cameras[name], "film", film))

    def arm(self, armed: bool) -> None:
        """Pauses (``armed``) or continues all live views."""

        def hold() -> None:
            for camera in self._cameras.values():
                camera.held = armed

        self._do(hold)

    def release(self, at_s: Mapping[str, float]) -> None:
        """Triggers the cameras in ``at_s``, each at its time (time.monotonic, s). The live views of the other cameras
        continue."""

        def plan() -> None:
            for name, camera in self._cameras.items():
                if name in at_s:
                    self._loop.call_at(at_s[name], self._expose, camera)
                else:
                    camera.held = False

        self._do(plan)

    def disturb(self, name: str, *, frozen: bool = False, hung: bool = False, drop_next: bool = False) -> None:
        """Sets a camera's faults. A ``frozen`` camera repeats its last picture, a ``hung`` camera sends nothing, and
        ``drop_next`` loses the next triggered frame."""

        def change() -> None:
            camera = self._cameras[name]
            camera.frozen, camera.hung, camera.drop_next = frozen, hung, drop_next

        self._do(change)

    def connect(self, views: Mapping[str, str]) -> None:
        """Sets the camera whose pictures each URL shows, to simulate exchanged cables."""
        self._do(lambda: self._views.update(views))

    def _do(self, work: Callable[[], Any]) -> None:
        """Runs ``work`` in the event loop and waits for its end."""
        done = threading.Event()

        def run() -> None:
            work()
            done.set()

        self._loop.call_soon_threadsafe(run)
        done.wait()

    def _run(self, work: Coroutine[Any, Any, None]) -> None:
        asyncio.run_coroutine_threadsafe(work, self._loop).result()

    async def _shut_down(self) -> None:
        for camera in self._cameras.values():
            if camera.tick is not None:
                camera.tick.cancel()
        self._server.close()
        for client in list(self._clients):
            client.cancel()
        await asyncio.gather(*self._clients, return_exceptions=True)
        await self._server.wait_closed()

    def _tick(self, camera: _Camera) -> None:
        camera.tick = self._loop.call_later(self._period_s, self._tick, camera)
        if not camera.held and camera.film is not None:
            camera.ticks += 1
            self._emit(camera, camera.film.live[camera.ticks % len(camera.film.live)])

    def _expose(self, camera: _Camera) -> None:
        camera.held = False
        if camera.tick is not None:
            camera.tick.cancel()
        camera.tick = self._loop.call_later(self._period_s, self._tick, camera)
        if camera.drop_next:
            camera.drop_next = False
        elif camera.film is not None:
            camera.releases += 1  # counted apart: two in a row are never the same picture, however many frames passed
            self._emit(camera, camera.film.released[camera.releases % len(camera.film.released)])

    def _emit(self, camera: _Camera, take: bytes) -> None:
        if camera.hung:
            return
        camera.frames += 1
        if not camera.frozen or not camera.shown:
            camera.shown = take
        event, camera.shown_event = camera.shown_event, asyncio.Event()
        event.set()

    async def _serve(self, reader: asyncio.StreamReader, writer: asyncio.StreamWriter) -> None:
        task = asyncio.current_task()
        assert task is not None
        self._clients.add(task)
        try:
            await self._answer(reader, writer)
        except (ConnectionError, ValueError, asyncio.IncompleteReadError, asyncio.CancelledError):
            pass  # the client left, or the studio closes
        finally:
            self._clients.discard(task)
            writer.close()

    async def _answer(self, reader: asyncio.StreamReader, writer: asyncio.StreamWriter) -> None:
        request = (await reader.readline()).decode("latin-1").split(" ")
        while (await reader.readline()).strip():
            pass
        if len(request) < 2:
            return
        target = urlsplit(request[1])
        name = target.path.removeprefix("/").removesuffix(".mjpeg")
        if name in self._views and target.path.endswith(".mjpeg"):
            await self._stream(name, reader, writer)
            return
        query = {key: values[-1] for key, values in parse_qs(target.query).items()}
        status, text = await self._loop.run_in_executor(None, self._control, request[0], target.path, query)
        body = text.encode()
        kind = "text/html" if text.startswith("<!") else "text/plain"
        head = f"HTTP/1.0 {status} -\r\nContent-Type: {kind}; charset=utf-8\r\nContent-Length: {len(body)}\r\n\r\n"
        writer.write(head.encode("latin-1") + body)
        await writer.drain()

    async def _stream(self, name: str, reader: asyncio.StreamReader, writer: asyncio.StreamWriter) -> None:
        writer.write(_HEAD)
        left = asyncio.ensure_future(reader.read())  # ends when the client does
        try:
            sent = {camera.name: camera.frames for camera in self._cameras.values()}
            while not left.done():
                camera = self._cameras[self._views[name]]
                if camera.frames == sent[camera.name]:
                    await self._wait(camera, left)
                    continue
                sent[camera.name] = camera.frames
                jpeg = camera.shown
                head = f"--frame\r\nContent-Type: image/jpeg\r\nContent-Length: {len(jpeg)}\r\n"
                writer.write(f"{head}X-Timestamp: {time.time():.6f}\r\n\r\n".encode("ascii"))
                await asyncio.sleep(0)  # every camera's header, by which arrivals are stamped, before the first picture
                writer.write(jpeg + b"\r\n")
                await writer.drain()
        finally:
            left.cancel()

    async def _wait(self, camera: _Camera, left: asyncio.Future[bytes]) -> None:
        """Waits until the camera has a frame, the client disconnects, or a short time has passed."""
        shown = asyncio.ensure_future(camera.shown_event.wait())
        try:
            await asyncio.wait({left, shown}, timeout=self._period_s, return_when=asyncio.FIRST_COMPLETED)
        finally:
            shown.cancel()
