"""``eigenhead demo``: the main job through the real service, from the trigger to the head."""

import os
import subprocess
import sys
import tempfile
import time
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import Any

from rig.errors import EigenheadError
from server.client import Client, Unreachable
from server.serve import listen
from server.settings import ServiceSettings
from server.truth import error_mm

START_S = 60.0

Report = Callable[[str, float], None]


class ServiceDied(EigenheadError):
    def __init__(self, log: Path) -> None:
        super().__init__(f"the service did not start:\n{log.read_text(errors='replace')[-2000:]}")


def run_demo(out: Path, *, seed: int, report: Report) -> dict[str, Any]:
    """Starts a service in a temporary data folder, triggers its simulated rig, submits the job, follows it, and fetches
    the result into ``out``. Returns what ``demo --json`` prints."""
    began = time.monotonic()
    with tempfile.TemporaryDirectory(prefix="eigenhead-demo-") as scratch:
        data = Path(scratch) / "data"
        report("service", 0.0)
        with _service(data) as url, Client(url) as client:
            report("capture", 0.05)
            capture = client.post("/v1/captures", {"seed": seed, "label": "demo"})
            job = client.submit(capture["id"])
            job = client.wait(job["id"], report=lambda stage, fraction: report(stage, 0.2 + 0.75 * fraction))
            report("fetch", 0.95)
            client.download(job["id"], out)
        error = error_mm(data / "captures" / capture["id"] / "truth", out / "head.ply")
    return {
        "ply": str(out / "head.ply"),
        "contact_sheet": str(out / "contact_sheet.png"),
        "seconds": round(time.monotonic() - began, 3),
        "error_mm": {name: round(value, 4) for name, value in error.items()},
        "warnings": client_warnings(out / "report.json"),
    }


def client_warnings(report: Path) -> list[str]:
    import json

    return [warning["message"] for warning in json.loads(report.read_text())["warnings"]]


@contextmanager
def _service(data: Path) -> Iterator[str]:
    """A service process on a free port, which ends with the block."""
    with listen("127.0.0.1", 0) as sock:
        port = sock.getsockname()[1]
    settings = ServiceSettings(data=data, port=port, host="127.0.0.1", free_bytes=0)
    log = data.parent / "service.log"
    command = [sys.executable, "-m", "server.cli", "serve"]
    with log.open("wb") as stream:
        process = subprocess.Popen(
            command, env=os.environ | settings.environment(), stdout=stream, stderr=stream, stdin=subprocess.DEVNULL
        )
    url = f"http://127.0.0.1:{port}"
    try:
        _await(process, url, log)
        yield url
    finally:
        process.terminate()
        process.wait(30)


def _await(process: "subprocess.Popen[bytes]", url: str, log: Path) -> None:
    deadline = time.monotonic() + START_S
    with Client(url, patience_s=0.0) as client:
        while time.monotonic() < deadline and process.poll() is None:
            try:
                client.get("/healthz")
                return
            except Unreachable:
                time.sleep(0.05)
    raise ServiceDied(log)
