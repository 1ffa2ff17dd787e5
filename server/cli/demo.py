"""Implements ``eigenhead demo``: runs a job on a real service, from the trigger to the head, and with ``--compare`` a
second one by the paper's simplex."""

import json
import subprocess
import tempfile
import time
from collections.abc import Iterator
from contextlib import contextmanager
from itertools import pairwise
from pathlib import Path
from typing import TypedDict

import cv2
import numpy as np

from pipeline.results.overlays import PANEL
from pipeline.settings import settings_from_document
from rig.errors import EigenheadError
from rig.formats.pictures.images import write_image
from rig.progress import Progress
from server.address import listen
from server.cli.client import Client, Unreachable
from server.processes import python_command, python_environment
from server.services.truth import error_mm
from server.settings import ServiceSettings
from server.tasks.prepare import prepare_kernels

START_S = 60.0
STRIP = 60  # height of a heading, pixels


class ServiceDied(EigenheadError):
    """Reports that the demo's service process ended before the demo did. The message has the end of its log."""

    def __init__(self, log: Path) -> None:
        super().__init__(f"the service did not start:\n{log.read_text(errors='replace')[-2000:]}")


class MethodDocument(TypedDict):
    """Describes one solver's result: its files, its distance from the truth (mm), and its cost in seconds and
    evaluations."""

    ply: str
    error_mm: dict[str, float]
    seconds: float
    evaluations: int
    stopped_because: str
    warnings: list[str]


class DemoDocument(TypedDict):
    """Describes what ``demo --json`` prints: the contour solver's result, and under ``methods`` that of each solver."""

    ply: str
    contact_sheet: str
    seconds: float
    error_mm: dict[str, float]
    warnings: list[str]
    methods: dict[str, MethodDocument]


def run_demo(out: Path, *, seed: int, full: bool, compare: bool, report: Progress) -> DemoDocument:
    """Starts a service in a temporary data folder, triggers its simulated rig, submits a job, waits for it, and
    downloads its result into ``out``.

    Args:
        out: folder of the result.
        seed: seed of the simulated subject.
        full: run the default job, with the dense stage; otherwise a head at level ``photo``.
        compare: solve by the paper's simplex too, into ``out/simplex``, and show both results side by side.
        report: receives the stage and the share of the whole that is done.

    Returns:
        What ``demo --json`` prints.
    """
    began = time.monotonic()
    requested: dict[str, object] = {} if full else {"detail": "photo", "outputs": {"surface": "head"}}
    prepare_kernels(_part(report, "", 0.0, 0.0), settings_from_document(requested))
    with tempfile.TemporaryDirectory(prefix="eigenhead-demo-") as scratch:
        data = Path(scratch) / "data"
        report("service", 0.0)
        with _service(data) as url, Client(url) as client:
            report("capture", 0.05)
            capture = client.post("/v1/captures", {"seed": seed, "label": "demo"})
            folders = {"contour": out} | ({"simplex": out / "simplex"} if compare else {})
            starts = {"contour": 0.1, "simplex": 0.4, "": 1.0}
            for method, after in pairwise([*folders, ""]):  # one at a time, since both render
                start, share = starts[method], starts[after] - starts[method]
                job = client.submit(capture["id"], settings=requested | {"method": method})
                client.wait(job["id"], report=_part(report, f"{method}: ", start, share))
                client.download(job["id"], folders[method])
        truth = data / "captures" / capture["id"] / "truth"
        documents = {method: _described(folders[method], truth) for method in folders}
    if compare:
        side_by_side(documents, out / "contact_sheet.png")
    return {
        "ply": documents["contour"]["ply"],
        "contact_sheet": str(out / "contact_sheet.png"),
        "seconds": round(time.monotonic() - began, 3),
        "error_mm": documents["contour"]["error_mm"],
        "warnings": documents["contour"]["warnings"],
        "methods": documents,
    }


def _part(report: Progress, name: str, start: float, share: float) -> Progress:
    return lambda stage, fraction: report(name + stage, start + share * fraction)


def _described(folder: Path, truth: Path) -> MethodDocument:
    document = json.loads((folder / "report.json").read_text())
    return {
        "ply": str(folder / "head.ply"),
        "error_mm": {name: round(value, 4) for name, value in error_mm(truth, folder / "head.ply").items()},
        "seconds": round(document["seconds"]["total"], 3),
        "evaluations": document["evaluations"],
        "stopped_because": document["stopped_because"],
        "warnings": [warning["message"] for warning in document["warnings"]],
    }


def side_by_side(documents: dict[str, MethodDocument], target: Path) -> None:
    """Writes one picture that joins the contact sheets of all solvers: the input and the start once, then silhouettes
    and head of each solver."""
    columns = []
    for method, described in documents.items():
        sheet = cv2.imread(str(Path(described["ply"]).with_name("contact_sheet.png")))
        assert sheet is not None  # the job wrote it
        both = [sheet[:, : 2 * PANEL[0]]] if not columns else []  # input, before the fit: the same for every solver
        caption = (
            f"{method}: {described['error_mm']['median']:.2f} mm median error, {described['evaluations']} evaluations"
        )
        headings = ["input, and before the fit"] * len(both) + [caption]
        for part, heading in zip([*both, sheet[:, 2 * PANEL[0] :]], headings, strict=True):
            columns.append(np.vstack([_strip(part.shape[1], heading), part.astype(np.uint8)]))
    write_image(target, np.hstack(columns)[:, :, ::-1])


def _strip(width: int, text: str) -> np.ndarray:
    strip = np.full((STRIP, width, 3), 40, np.uint8)
    return cv2.putText(strip, text, (12, 40), cv2.FONT_HERSHEY_SIMPLEX, 1.0, (255, 255, 255), 1, cv2.LINE_AA)


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
