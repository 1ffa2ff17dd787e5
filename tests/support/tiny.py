"""Work that stands for a reconstruction where the engine around it is tested: real files, real time, no head."""

import hashlib
import json
import os
import time
from pathlib import Path
from typing import Any

from rig.errors import InputError
from rig.files import write_atomically
from rig.formats.captures.capture_folder import read_capture
from rig.progress import Progress
from server.tasks.child import WorkerContext
from tests.support.pinned_work import picture_bytes, pinned_report


def work(
    context: WorkerContext, report: Progress, *, capture: str, result: str, cache: str, settings: Any, **others: Any
) -> dict[str, Any]:
    """Takes ``EIGENHEAD_TINY_S`` seconds, or as many as ``front`` is. Its files follow from the capture alone."""
    shot, _ = read_capture(Path(capture))
    seconds = float(os.environ.get("EIGENHEAD_TINY_S", "0.2"))
    mode = settings.get("front") or ""
    if mode[:1].isdigit():
        seconds = max(float(mode), 1e-3)
    if mode in ("long", "deaf"):
        seconds = 120.0  # a slow machine needs 30 s to start a service again under it
    if mode == "fail":
        raise InputError("capture", ["cam00 sees nobody", "cam01 sees nobody"])
    if mode == "crash":
        os.kill(os.getpid(), 11)
    if mode == "short below photo" and settings.get("detail") != "photo":
        raise MemoryError
    if mode == "killed" or (mode == "killed below photo" and settings.get("detail") != "photo"):
        os.kill(os.getpid(), 9)
    if mode == "killed once" and not (killed := Path(cache) / "killed").exists():
        write_atomically(killed, b"")
        os.kill(os.getpid(), 9)
    if mode == "bug":
        raise ZeroDivisionError("planted")
    if mode == "quiet":
        report("depth", 0.0)
        time.sleep(1.0)
    began = time.monotonic()
    while (share := (time.monotonic() - began) / seconds) < 1:
        if mode != "deaf":
            report("fit", share)
        time.sleep(0.01)
    if mode in ("moved", "killed below photo", "short below photo"):
        warning = {"code": "camera-moved", "message": "cam02 has moved by 5.0 px"}
        report_json = json.dumps({"warnings": [{"code": "other", "message": "?"}, warning]})
        write_atomically(Path(result) / "report.json", report_json.encode())
    for name in ("head.ply", "head.glb", "overlays/cam00.png"):
        digest = hashlib.sha256(f"{name}{sorted(shot.digests.items())}".encode()).digest()
        repeats = int(os.environ.get("EIGENHEAD_TINY_BYTES", "64000")) // len(digest)
        write_atomically(Path(result) / name, digest * repeats)
    return {}


def busy(context: WorkerContext, report: Progress, *, result: str, **others: Any) -> dict[str, Any]:
    """About a second of one core, by count and not by clock, so that a busy core takes longer."""
    digest = b""
    for step in range(100):
        report("fit", step / 100)
        for _ in range(9000):
            digest = hashlib.sha256(digest).digest()
    write_atomically(Path(result) / "head.ply", digest)
    return {}


def reporting(
    context: WorkerContext, report: Progress, *, capture: str, result: str, settings: dict[str, Any], **others: Any
) -> dict[str, Any]:
    """Writes what tables and sheets read of a head, its numbers drawn from the capture."""
    shot, _ = read_capture(Path(capture))
    digest = hashlib.sha256(f"{sorted(shot.digests.items())}".encode()).digest()
    write_atomically(Path(result) / "report.json", json.dumps(pinned_report(digest[0], settings)).encode())
    write_atomically(Path(result) / "turntable.png", picture_bytes(digest))
    return {}
