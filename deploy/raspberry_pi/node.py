"""Serves a Raspberry Pi's camera to a rig (driver ``node`` of rig.toml). It needs Raspberry Pi OS with its
python3-picamera2, and no other file of this project:

    python3 node.py                        at each start of the Pi: `@reboot python3 /home/pi/node.py` by `crontab -e`
    python3 node.py --login FILE           FILE has one line, user:password, which rig.toml's address must name

GET /stream?width=4056&height=3040&exposure_ms=8 answers with motion JPEG. The settings are those of rig.toml;
X-Unmet names those that the camera did not take. X-Age-Ms of each picture is the time since its exposure began, so that
no clock of the Pi has to be right. With trigger=software a picture is sent for each POST /trigger, exposed after it.
A new stream ends the one before.
"""

import argparse
import base64
import hmac
import io
import sys
import threading
import time
from collections.abc import Callable, Mapping
from http.server import BaseHTTPRequestHandler, ThreadingHTTPServer
from pathlib import Path
from urllib.parse import parse_qsl, urlsplit

from picamera2 import Picamera2

BOUNDARY = "picture"
TIMEOUT_S = 10.0  # of somebody who sends nothing, or takes nothing
NUMBERS: Mapping[str, Callable[[float], dict[str, object]]] = {
    "fps": lambda value: {"FrameRate": value},
    "exposure_ms": lambda value: {"ExposureTime": round(1000.0 * value), "AeEnable": False},
    "gain_db": lambda value: {"AnalogueGain": 10.0 ** (value / 20.0), "AeEnable": False},
    "white_balance_k": lambda value: {"ColourTemperature": round(value), "AwbEnable": False},
}  # controls of libcamera by a setting of rig.toml


class Node:
    """Holds the camera, which one stream at a time has."""

    def __init__(self) -> None:
        self.camera = Picamera2()
        self.using = threading.Lock()
        self.changed = threading.Condition()
        self.turn = 0  # of the stream that came last
        self.released_ns: int | None = None

    def configure(self, settings: Mapping[str, str]) -> list[str]:
        """Starts the camera with the settings, and returns the names of those that it does not have."""
        camera, controls, unmet = self.camera, dict[str, object](), list[str]()
        size = (
            int(settings.get("width", camera.sensor_resolution[0])),
            int(settings.get("height", camera.sensor_resolution[1])),
        )
        for key, value in settings.items():
            if key in NUMBERS:
                wanted = NUMBERS[key](float(value))
                if all(_within(camera.camera_controls, name, each) for name, each in wanted.items()):
                    controls |= wanted
                else:
                    unmet.append(key)
        camera.stop()
        camera.configure(camera.create_video_configuration(main={"size": size}, controls=controls))
        camera.start()
        found = camera.camera_configuration()["main"]["size"]
        return unmet + [key for key, k in (("width", 0), ("height", 1)) if found[k] != size[k]]

    def take(self, after_ns: int) -> tuple[bytes, int]:
        """Returns the first picture that is exposed after a moment (time.monotonic_ns), and when that began."""
        request, data = self.camera.capture_request(flush=after_ns), io.BytesIO()
        try:
            known = request.get_metadata()
            request.save("main", data, format="jpeg")
        finally:
            request.release()
        return data.getvalue(), known["SensorTimestamp"] - 1000 * known["ExposureTime"]  # the stamp is of the readout

    def release(self) -> None:
        """Releases a picture of a stream with a software trigger."""
        with self.changed:
            self.released_ns = time.monotonic_ns()
            self.changed.notify_all()

    def claim(self) -> int:
        """Ends the stream before, and returns the turn of this one."""
        with self.changed:
            self.turn += 1
            self.released_ns = None
            self.changed.notify_all()
            return self.turn

    def wait_released(self, turn: int) -> int | None:
        """Returns when the next picture was released, or None at the end of the turn."""
        with self.changed:
            self.changed.wait_for(lambda: self.released_ns is not None or self.turn != turn)
            moment, self.released_ns = self.released_ns, None
            return moment if self.turn == turn else None


def _within(known: Mapping[str, tuple[float, float, float]], name: str, value: object) -> bool:
    if name == "FrameRate":  # libcamera bounds the time between frames, in microseconds
        return name in known or "FrameDurationLimits" in known
    if name not in known or isinstance(value, bool):
        return name in known
    least, most, _ = known[name]
    return not most or least <= float(str(value)) <= most


class Handler(BaseHTTPRequestHandler):
    """Answers one request."""

    node: Node
    login = b""
    timeout = TIMEOUT_S

    def do_GET(self) -> None:
        """Streams pictures, until the next stream begins."""
        parts = urlsplit(self.path)
        if not self._known(parts.path == "/stream"):
            return
        settings = dict(parse_qsl(parts.query))
        turn = self.node.claim()
        with self.node.using:  # once the stream before has seen that its turn is over
            try:
                unmet = self.node.configure(settings)
            except (ValueError, RuntimeError) as error:
                self.send_error(400, str(error).splitlines()[0][:200])
                return
            self.send_response(200)
            self.send_header("Content-Type", f"multipart/x-mixed-replace; boundary={BOUNDARY}")
            self.send_header("X-Unmet", ",".join(unmet))
            self.end_headers()
            self._stream(turn, settings.get("trigger") == "software")

    def _stream(self, turn: int, released: bool) -> None:
        after_ns: int | None = time.monotonic_ns()
        while self.node.turn == turn:
            after_ns = self.node.wait_released(turn) if released else after_ns
            if after_ns is None:
                return
            jpeg, taken_ns = self.node.take(after_ns)
            after_ns = taken_ns + 1
            age_ms = (time.monotonic_ns() - taken_ns) / 1e6
            head = f"--{BOUNDARY}\r\nContent-Type: image/jpeg\r\nContent-Length: {len(jpeg)}\r\nX-Age-Ms: {age_ms:.3f}"
            try:
                self.wfile.write(head.encode() + b"\r\n\r\n" + jpeg + b"\r\n")
            except OSError:  # nobody listens any more
                return

    def do_POST(self) -> None:
        """Releases a picture."""
        if self._known(self.path == "/trigger"):
            self.node.release()
            self.send_response(204)
            self.end_headers()

    def _known(self, path: bool) -> bool:
        sent = self.headers.get("Authorization", "").encode()
        if self.login and not hmac.compare_digest(sent, b"Basic " + base64.b64encode(self.login)):
            self.send_error(401)
        elif not path:
            self.send_error(404)
        else:
            return True
        return False


def main() -> None:
    """Serves until it is ended."""
    parser = argparse.ArgumentParser(description="Serves a Raspberry Pi's camera to a rig.")
    parser.add_argument("--host", default="", help="address to listen at (default: all of the Pi's)")
    parser.add_argument("--port", type=int, default=8080)
    parser.add_argument("--login", type=Path, help="a file with user:password")
    options = parser.parse_args()
    Handler.node = Node()
    Handler.login = options.login.read_bytes().strip() if options.login else b""
    server = ThreadingHTTPServer((options.host, options.port), Handler)
    server.daemon_threads = True
    sys.stdout.write(f"serving at port {server.server_address[1]}\n")
    sys.stdout.flush()
    server.serve_forever()


if __name__ == "__main__":
    main()
