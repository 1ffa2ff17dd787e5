"""Estimates what more cores would gain for a default job: where its processor seconds go, which of them are shared by
threads, and how long the job would then take.

A capture is reconstructed by the command line, with one thread and with as many as there are processors. Everything but
the wall-clock seconds is computed from the processor seconds of the first run, which a busy machine changes little.
Peak memory is that of the child process over its whole life.
"""

import json
import os
import subprocess
import tempfile
import time
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from pipeline.compute import threads as pool
from pipeline.compute import trace
from pipeline.compute.threads import THREADS
from rig.errors import EigenheadError
from tests.laboratory.experiments import markdown
from tests.laboratory.experiments.records import Bench, Outcome, Row, key_of
from tests.laboratory.experiments.speed import critical_path
from tests.laboratory.experiments.speed.critical_path import JobWork, work_of

CORES = (1, 2, 4, 8, 16)
LISTED = 15  # parts and loops, those that cost most
MIN_S = 0.02  # of a part or loop that is listed


class JobFailed(EigenheadError):
    """Reports a job that failed, with the last lines of its output."""

    def __init__(self, capture: Path, said: str) -> None:
        super().__init__(f"{capture} could not be reconstructed: {said}")


@dataclass(frozen=True, slots=True, eq=False)
class JobCommand:
    """Holds the command line that reconstructs a capture, to which ``CAPTURE --out FOLDER --trace FILE`` is appended,
    and its environment variables."""

    words: Sequence[str]
    variables: Mapping[str, str]


def scaling(captures: Sequence[Path], *, command: JobCommand, bench: Bench, threads: int | None = None) -> Outcome:
    """Returns seconds and memory of each capture's default job with one thread and with ``threads`` (all CPUs).

    Raises JobFailed.
    """
    most = threads or len(os.sched_getaffinity(0))
    records = bench.records("scaling", key_of(pool, trace, critical_path, CORES))
    rows: list[Row] = []
    for done, capture in enumerate(captures):
        row: Row = {"name": capture.name}
        for share, count in enumerate(sorted({1, most})):
            bench.report(f"{capture.name}, threads: {count}", (done + share / 2) / len(captures))
            row[str(count)] = records.row(
                f"{capture.resolve()} {count}",
                lambda count=count, capture=capture: run_job(capture, command, count, bench.folder),
            )
        rows.append(row)
    figures: dict[str, float] = {}
    for row in rows:
        figures |= {(f"{row['name']}_" if len(rows) > 1 else "") + key: value for key, value in _figures(row).items()}
    return {"figures": figures, "rows": rows, "markdown": "\n".join(_tables(row) for row in rows)}


def row_of(work: JobWork) -> Row:
    """Returns the seconds of a trace's stages, parts and loops: processor seconds, those that are serial, and how long
    each would take on so many cores."""
    sections = {"stages": work.stages, "parts": work.parts}
    listed = {
        key: [
            {"name": each.name, "cpu_s": each.cpu_s, "serial_s": each.serial_s, "seconds": _by_cores(each.seconds)}
            for each in found
        ]
        for key, found in sections.items()
    }
    loops = [
        {
            "name": name,
            "calls": len(visits),
            "seconds": _by_cores(lambda cores, visits=visits: sum(visit.seconds(cores) for visit in visits)),
        }
        for name, visits in work.loops().items()
    ]
    return {
        "cpu_s": work.cpu_s,
        "serial_s": work.serial_s,
        "seconds": _by_cores(work.seconds),
        **listed,
        "loops": loops,
    }


def _by_cores(seconds) -> dict[str, float]:
    return {str(cores): seconds(cores) for cores in CORES}


def run_job(capture: Path, command: JobCommand, threads: int, folder: Path | None) -> Row:
    """Runs a job in a child process. Returns its wall-clock seconds, processor seconds, peak memory (MB), and the
    figures of its trace (``row_of``). The trace is left in ``folder``. Raises JobFailed."""
    with tempfile.TemporaryDirectory() as scratch:
        kept = Path(scratch) if folder is None else folder
        kept.mkdir(parents=True, exist_ok=True)
        path, log = kept / f"{capture.name}-{threads}.trace.json", Path(scratch) / "said"
        words = [*command.words, str(capture), "--out", str(Path(scratch) / "head"), "--trace", str(path)]
        began = time.perf_counter()
        with log.open("wb") as said:
            child = subprocess.Popen(
                words, env={**command.variables, THREADS: str(threads)}, stdout=said, stderr=subprocess.STDOUT
            )
            _, status, usage = os.wait4(child.pid, 0)
        child.returncode = os.waitstatus_to_exitcode(status)
        wall_s = time.perf_counter() - began
        if child.returncode:
            lines = log.read_text(errors="replace").strip().splitlines()
            raise JobFailed(capture, lines[-1] if lines else f"exit status {child.returncode}")
        document = json.loads(path.read_text())
    spent = {"wall_s": wall_s, "process_cpu_s": usage.ru_utime + usage.ru_stime, "peak_mb": document["peak_memory_mb"]}
    return spent | row_of(work_of(document))


def _figures(row: Row) -> dict[str, float]:
    one = row["1"]
    figures = {"cpu_s": one["cpu_s"], "serial_s": one["serial_s"], "serial_share": one["serial_s"] / one["cpu_s"]}
    figures |= {f"predicted_{cores}_s": seconds for cores, seconds in one["seconds"].items()}
    for count, run in row.items():
        if count != "name":
            figures |= {f"{key}_threads_{count}": run[key] for key in ("wall_s", "process_cpu_s", "peak_mb")}
    return figures


def _tables(row: Row) -> str:
    one, cores = row["1"], [str(count) for count in CORES]
    whole = {"name": "all", **one}
    header = ("serial, s", *(f"{count} core{'s' * (count != '1')}, s" for count in cores))
    stages = [_cells(each) for each in (*one["stages"], whole)]
    parts = [_cells(each) for each in _dearest(one["parts"], lambda each: each["serial_s"])]
    loops = [
        [loop["name"], loop["calls"], *(loop["seconds"][count] for count in cores)]
        for loop in _dearest(one["loops"], lambda loop: loop["seconds"]["1"])
    ]
    texts = [
        f"## {row['name']}\n",
        markdown.table(("stage", *header), stages),
        markdown.table(("part, by what is serial", *header), parts),
        markdown.table(("loop", "calls", *header[1:]), loops),
    ]
    return "\n".join(texts)


def _cells(section: Mapping[str, Any]) -> list[markdown.Cell]:
    return [section["name"], section["serial_s"], *section["seconds"].values()]


def _dearest(rows: Sequence[Row], seconds) -> list[Row]:
    return [row for row in sorted(rows, key=seconds, reverse=True)[:LISTED] if seconds(row) >= MIN_S]
