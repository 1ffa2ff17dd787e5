"""What SIGKILLs leave of a batch: of pinned work, or of heads of the studio at the level span.

python -m tests.laboratory batch_kills pinned 500 20
python -m tests.laboratory batch_kills real 60 20

Each process that is killed has a share of one folder. ``results``: complete ones at the end; ``bytes_differ``:
files that are not those of an undisturbed run (but for seconds); ``left_over``: files that an undisturbed run does not
have; ``begun_twice``: captures that two undisturbed processes with a share each (``1/2``, ``2/2``) both began, of
pinned work.
"""

import os
import random
import signal
import subprocess
import sys
import time
from collections import Counter
from pathlib import Path
from typing import Any, Literal

from rig.render.renderer import Renderer
from tests.support.pinned_batch import everything_in, pinned_captures
from tests.support.pinned_work import LOG, SECONDS
from tests.support.services import ROOT
from tests.support.small_studio import small_studio_captures

PINNED_S = "0.05"
SEED = 37


def command_of(kind: str, shots: Path, out: Path, shard: str) -> list[str]:
    if kind == "pinned":
        return [sys.executable, "-m", "tests.support.pinned_batch", str(shots), str(out), "2", shard]
    options = ["--out", str(out), "--detail", "span", "--surface", "head", "--workers", "2", "--shard", shard]
    return [sys.executable, "-m", "server.cli", "batch", str(shots), *options]


def start(kind: str, shots: Path, out: Path, log: Path | None = None, shard: str = "1/1") -> "subprocess.Popen[bytes]":
    environment = os.environ | {SECONDS: PINNED_S} | ({} if log is None else {LOG: str(log)})
    quiet = subprocess.DEVNULL
    return subprocess.Popen(command_of(kind, shots, out, shard), cwd=ROOT, env=environment, stdout=quiet, stderr=quiet)


def finish(running: "list[subprocess.Popen[bytes]]") -> float:
    """Seconds until all have ended, each with status 0."""
    began = time.monotonic()
    for process in running:
        assert process.wait() == 0, process.args
    return time.monotonic() - began


def kill_often(kind: str, shots: Path, out: Path, *, kills: int, processes: int, seconds: float) -> None:
    """SIGKILL to one process after the other, each started again, spread over the time that the work takes."""
    rng = random.Random(SEED)
    shares = [f"{number + 1}/{processes}" for number in range(processes)]
    running = [start(kind, shots, out, shard=share) for share in shares]
    for number in range(kills):
        time.sleep(rng.uniform(0.5, 1.5) * seconds / kills)
        victim = running[number % processes]
        victim.send_signal(signal.SIGKILL)
        victim.wait()
        running[number % processes] = start(kind, shots, out, shard=shares[number % processes])
    finish(running)


def begun_twice(shots: Path, folder: Path, shards: tuple[str, str]) -> int:
    """How many captures two processes both began, which between them have begun all."""
    log = folder / "log"
    finish([start("pinned", shots, folder / "heads", log, shard) for shard in shards])
    begun = Counter(line.split()[2] for line in log.read_text().splitlines() if " begins " in line)
    assert begun.keys() == {path.name for path in shots.iterdir()}
    return sum(count > 1 for count in begun.values())


def run(
    kind: Literal["pinned", "real"], captures: int | None = None, kills: int = 20, processes: int = 2, *, scratch: Path
) -> dict[str, Any]:
    """Returns the figures of this module. ``captures``: 500 of pinned work, 60 of real work."""
    shots, captures = scratch / "shots", captures or (500 if kind == "pinned" else 60)
    if kind == "pinned":
        pinned_captures(shots, captures)
    else:
        with Renderer.create() as renderer:
            small_studio_captures(shots, captures, renderer)
    undisturbed, out = scratch / "undisturbed" / "heads", scratch / "killed" / "heads"
    seconds = finish([start(kind, shots, undisturbed)])
    began = time.monotonic()
    kill_often(kind, shots, out, kills=kills, processes=processes, seconds=seconds)
    killed_s = time.monotonic() - began
    wanted, found = everything_in(undisturbed), everything_in(out)
    figures = {
        "captures": captures,
        "kills": kills,
        "processes": processes,
        "results": len(list(out.glob("*/batch.json"))),
        "files": len(found),
        "bytes_differ": sum(found.get(name) != digest for name, digest in wanted.items()),
        "left_over": len(found.keys() - wanted.keys()),
        "seconds_undisturbed": round(seconds, 1),
        "seconds_with_kills": round(killed_s, 1),
    }
    twice = {"begun_twice": begun_twice(shots, scratch, ("1/2", "2/2"))} if kind == "pinned" else {}
    return {"figures": figures | twice}
