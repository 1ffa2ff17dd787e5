"""Work that stands for a reconstruction where the batch around it is tested. Loads little, as each test's children do.

``images/seed.txt`` of a capture decides every byte of its result but report.json's seconds; a file ``mode`` in it says
what shall go wrong.
"""

import hashlib
import json
import os
import signal
import time
from collections.abc import Mapping
from pathlib import Path
from typing import Any

import numpy as np

from pipeline.head_model.landmarks import NAMES
from rig.errors import InputError
from rig.files import write_atomically
from rig.messages.message import compose
from rig.progress import Progress
from server.processes import end_with_parent
from server.tasks.child import WorkerContext

SECONDS, LOG = "EIGENHEAD_PINNED_S", "EIGENHEAD_PINNED_LOG"
MEASURED = ("head_breadth", "head_length", "nose_length")


def pinned_report(seed: int, settings: Mapping[str, object], seconds: float = 1.5) -> dict[str, Any]:
    """What the table and the sheet read of a report, its numbers drawn from the seed."""
    rng = np.random.default_rng(seed)
    draw = lambda low, high: float(rng.uniform(low, high))  # noqa: E731
    camera = {"used": True, "contour_rms_px": draw(0.2, 2.0)}
    blind = {"used": False, "contour_rms_px": None}
    return {
        "version": "0.1.0",
        "model": {"name": "makehuman-138", "sha256": "ab" * 32},
        "method": "contour",
        "detail": {"level": "span", "reason": "it is made up"},
        "front": "cam00",
        "pose": {"method": "silhouettes", "rival": None, "off": {}, "doubtful": False},
        "cameras": {"cam00": camera, "cam01": dict(camera), "cam02": blind},
        "expression": [{"name": "jawOpen", "words": "jaw open", "weight": draw(0.1, 1), "std": draw(0.01, 0.1)}],
        "world_from_head": {"scale": draw(0.9, 1.1)},
        "landmarks": {
            name: {"position": [draw(-90, 90) for _ in range(3)], "std": [draw(0, 2) for _ in range(3)]}
            for name in NAMES
        },
        "measurements": {name: {"value": draw(10, 200), "std": None} for name in MEASURED},
        "quality": {"median": draw(0.2, 2), "max": draw(3, 20)},
        "seconds": {"total": seconds},
        "settings": settings,
        "inputs": {},
        "warnings": [compose("view", remark=f"seed {seed}").document()],
    }


def work(
    context: WorkerContext, report: Progress, *, parent: int, capture: str, result: str, scratch: str, **others: Any
) -> None:
    """Takes ``EIGENHEAD_PINNED_S`` seconds and writes what follows from the capture alone."""
    end_with_parent(parent)
    folder, out, began = Path(capture), Path(result), time.monotonic()
    _note("begins", folder.name)
    mode = (folder / "mode").read_text() if (folder / "mode").is_file() else ""
    (Path(scratch) / "half").write_bytes(b"x" * 1000)
    _go_wrong(mode, folder)
    seconds = float(os.environ.get(SECONDS, "0.05"))
    while (share := (time.monotonic() - began) / seconds) < 1:
        report("fit", share)
        time.sleep(0.005)
    seed = int((folder / "images" / "seed.txt").read_text())
    digest = hashlib.sha256(f"{seed}".encode()).digest()
    for name in ("head.ply", "head.glb", "overlays/cam00.png"):
        write_atomically(out / name, digest * 2000)
    (out / "turntable.png").write_bytes(picture_bytes(digest))
    text = json.dumps(pinned_report(seed, others["settings"], time.monotonic() - began))
    write_atomically(out / "report.json", text.encode())
    _note("ends", folder.name)


def _go_wrong(mode: str, folder: Path) -> None:
    if mode == "fail":
        raise InputError("capture", [compose("batch-capture-unnamed"), compose("batch-list-empty")])
    if mode == "bug":
        raise ZeroDivisionError("planted")
    if mode == "memory":
        np.ones(1 << 50)  # a petabyte
    if mode == "changed":
        (folder / "images" / "late.txt").write_text("a camera was slow")
    if mode == "segfault":
        os.kill(os.getpid(), signal.SIGSEGV)
    if mode == "killed":
        os.kill(os.getpid(), signal.SIGKILL)


def _note(what: str, name: str) -> None:
    """One line of the log that all processes share; an append of less than a page is whole."""
    if LOG in os.environ:
        with Path(os.environ[LOG]).open("a") as log:
            log.write(f"{time.monotonic():.6f} {what} {name} {os.getpid()}\n")


def picture_bytes(shades: bytes) -> bytes:
    """Nine grey panels of 4 x 6 pixels, as a PPM file: OpenCV goes by the content."""
    row = np.repeat(np.frombuffer(shades[:9], np.uint8), 4)
    return b"P6 36 6 255\n" + np.repeat(np.tile(row, (6, 1))[..., None], 3, axis=2).tobytes()
