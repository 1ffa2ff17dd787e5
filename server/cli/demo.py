"""Implements ``eigenhead demo``: runs a job on a real service, from the trigger to the head."""

import json
import subprocess
import tempfile
import time
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import Any

from pipeline.settings import settings_from_document
from rig.errors import EigenheadError
from rig.progress import Progress
from server.address import listen
from server.cli.client import Client, Unreachable
from server.processes import python_command, python_environment
from server.services.truth import measure_error_mm
from server.settings import ServiceSettings
from server.tasks.prepare import prepare_kernels

START_S = 60.0


class ServiceDied(EigenheadError):
    """Reports that the demo's service process ended before the demo did. The message has the end of its log."""

    def __init__(self, log: Path) -> None:
        super().__init__(f"the service did not start:\n{log.read_text(errors='replace')[-2000:]}")


def run_demo(out: Path, *, seed: int, full: bool, report: Progress) -> dict[str, Any]:
    """Starts a service in a temporary data folder, triggers its simulated rig with the subject of ``seed``, runs a job,
    and downloads the job's result into ``out``. ``full``: whether to run the default job, with the dense stage, or a
    short job (level ``photo``). Returns what ``demo --json`` prints: files, ``error_mm`` from the truth, warnings."""
    began = time.monotonic()
    requested: dict[str, object] = {} if full else {"detail": "photo", "outputs": {"surface": "head"}}
    prepare_kernels(lambda stage, _: report(stage, 0.0), settings_from_document(requested))
    with tempfile.TemporaryDirectory(prefix="eigenhead-demo-") as scratch:
        data = Path(scratch) / "data"
        report("service", 0.0)
        with _service(data) as url, Client(url) as client:
            report("capture", 0.05)
            capture = client.post("/v1/captures", {"seed": seed, "label": "demo"})
            job = client.submit(capture["id"], settings=requested)
            client.wait(job["id"], report=lambda stage, share: report(stage, 0.1 + 0.9 * share))
            client.download(job["id"], out)
        error = measure_error_mm(data / "captures" / capture["id"] / "truth", out / "head.ply")
    document = json.loads((out / "report.json").read_text())
    return {
        "ply": str(out / "head.ply"),
        "contact_sheet": str(out / "contact_sheet.png"),
        "seconds": round(time.monotonic() - began, 3),
        "error_mm": {name: round(value, 4) for name, value in error.items()},
        "warnings": [warning["message"] for warning in document["warnings"]],
    }


@contextmanager
def _service(data: Path) -> Iterator[str]:
    """Runs a service process on a free port and yields its address; the process ends with the block."""
    with listen("127.0.0.1", 0) as sock:
        port = sock.getsockname()[1]
    settings = ServiceSettings(data=data, port=port, host="127.0.0.1", free_bytes=0, console=False)
    log = data.parent / "service.log"
    command = python_command("cli", "serve")
    with log.open("wb") as stream:
        process = subprocess.Popen(
            command,
            env=python_environment() | settings.environment(),
            stdout=stream,
            stderr=stream,
            stdin=subprocess.DEVNULL,
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
