"""How long jobs would take on more cores: traces made by hand, of which the answer is known, and jobs in children."""

import json
import sys
from pathlib import Path
from typing import Any

import pytest

from pipeline.compute.trace import FORMAT
from tests.laboratory.experiments.records import Bench
from tests.laboratory.experiments.speed.critical_path import schedule, work_of
from tests.laboratory.experiments.speed.scaling import JobCommand, JobFailed, scaling

MAIN, HELPER = 10, 11


def span(kind: str, name: str, began: float, ended: float, *, thread: int = MAIN, **arguments: Any) -> dict[str, Any]:
    """A span in seconds; its thread works all the time, unless ``cpu_s`` says less."""
    args = {"cpu_s": ended - began, "process_cpu_s": ended - began} | arguments
    when = {"ts": 1e6 * began, "dur": 1e6 * (ended - began)}
    return {"ph": "X", "cat": kind, "name": name, "tid": thread, "args": args, **when}


def loop(
    number: int, began: float, slices: list[float], *, count: int | None = None, single: bool = False
) -> list[dict]:
    """A loop whose slices follow each other on the main thread."""
    count, ends = count or len(slices), [began]
    for seconds in slices:
        ends.append(ends[-1] + seconds)
    spans = [span("loop", f"loop {number}", began, ends[-1], loop=number, count=count, single=single)]
    bounds = [count * k // len(slices) for k in range(len(slices) + 1)]
    for k in range(len(slices)):
        spans.append(span("slice", "", ends[k], ends[k + 1], loop=number, first=bounds[k], last=bounds[k + 1]))
    return spans


def document(*spans: dict[str, Any], before_s: float = 0.0) -> dict[str, Any]:
    return {"format": FORMAT, "before_cpu_s": before_s, "peak_memory_mb": 512.0, "traceEvents": list(spans)}


def test_slices_go_to_the_core_that_is_free_first() -> None:
    assert schedule([3, 3, 2, 2, 2], 1) == 12
    assert schedule([3, 3, 2, 2, 2], 2) == 7  # the best order would take 6
    assert schedule([3, 3, 2, 2, 2], 5) == 3
    assert schedule([], 4) == 0


def test_a_stage_in_the_background_hides_behind_the_others() -> None:
    """6 s, 4 of them shared out, behind 3 s that are serial: one core 9, two 4.5, four 3 s."""
    spans = [
        span("job", "job", 0, 10),
        span("background", "b", 0, 6),
        span("stage", "b", 0, 6),
        *loop(0, 1, [0.25] * 16),
        span("foreground", "b", 6, 9),
        span("stage", "a", 6, 9),
    ]
    work = work_of(document(*spans))
    assert [work.seconds(cores) for cores in (1, 2, 4)] == pytest.approx([10.0, 1.0 + 4.5, 1.0 + 3.0])
    assert work.cpu_s == pytest.approx(10.0)
    assert work.serial_s == pytest.approx(1.0 + 3.0), "2 s of the background are serial, but another core's"


def test_what_no_loop_shares_stays_as_it_is() -> None:
    work = work_of(
        document(
            span("job", "job", 0, 13),
            span("stage", "a", 1, 11),
            *loop(0, 2, [1.0] * 8),
            span("stage", "b", 12, 13),
            before_s=0.5,
        )
    )
    assert [(each.name, each.cpu_s, each.serial_s) for each in work.stages] == [
        ("start", 0.5, 0.5), ("a", 10, 2), ("b", 1, 1), ("between", 2, 2),
    ]  # fmt: skip
    assert (work.cpu_s, work.serial_s) == (13.5, 5.5)
    assert [work.seconds(cores) for cores in (1, 2, 4, 8, 16)] == [13.5, 9.5, 7.5, 6.5, 6.5]


def test_fewer_cores_cut_a_loop_no_finer_than_they_do() -> None:
    work = work_of(document(span("stage", "a", 0, 4), *loop(0, 0, [1.0] * 4 + [0.0] * 28, count=64)))
    assert [work.seconds(cores) for cores in (1, 2, 4)] == [4, 4, 4]  # all in the first of 8 slices
    assert [work.seconds(cores) for cores in (8, 16)] == [2, 1]  # the first two of 16, four of 32
    tasks = work_of(document(span("stage", "a", 0, 12), *loop(0, 0, [1.0] * 12, single=True)))  # never cut together
    assert [tasks.seconds(cores) for cores in (1, 2, 8, 16)] == [12, 6, 2, 1]


def test_a_loop_within_a_slice_has_the_cores_that_are_left() -> None:
    spans = [
        span("stage", "a", 0, 12, process_cpu_s=21),
        span("loop", "tasks", 0, 12, loop=0, count=0, single=True, cpu_s=0),
        span("slice", "x", 0, 11, thread=HELPER, loop=0),  # of which 3 s serial and 8 in a loop of its own
        *({**each, "tid": HELPER} for each in loop(1, 2, [1.0] * 8)),
        span("slice", "y", 11, 12, thread=HELPER, loop=0, cpu_s=10),
    ]
    work = work_of(document(*spans))
    assert [loop.name for loop in work.stages[1].loops] == ["tasks"]
    assert work.stages[1].shared_s == 21
    assert work.seconds(1) == 21
    assert work.seconds(2) == 11  # x alone on its core
    assert work.seconds(4) == 10  # x takes 3 + 8 / 2, y ten


def test_parts_have_their_serial_seconds_and_loops_and_another_format_is_refused() -> None:
    spans = [
        span("stage", "a", 0, 10),
        span("part", "whole", 1, 9),
        span("part", "inner", 2, 8),
        *loop(0, 3, [1.0] * 4),
    ]
    found = {each.name: (each.cpu_s, each.serial_s, each.seconds(4)) for each in work_of(document(*spans)).parts}
    assert found == {"a: whole": (8, 4, 5), "a: inner": (6, 2, 3)}
    with pytest.raises(ValueError, match="eigenhead-trace/0"):
        work_of({"format": "eigenhead-trace/0", "traceEvents": []})


def job_of(folder: Path, program: str) -> JobCommand:
    (folder / "job.py").write_text(program)
    return JobCommand([sys.executable, str(folder / "job.py")], {"PATH": ""})


def test_jobs_run_in_children_and_their_rows_are_kept_or_it_is_said_why_not(tmp_path: Path) -> None:
    trace = document(span("stage", "a", 0, 10), *loop(0, 2, [1.0] * 8))
    program = (
        "import os, sys\n"
        f"open({str(tmp_path / 'runs')!r}, 'a').write(os.environ['EIGENHEAD_THREADS'] + ' ' + sys.argv[1] + '\\n')\n"
        f"open(sys.argv[sys.argv.index('--trace') + 1], 'w').write({json.dumps(trace)!r})\n"
    )
    command, out = job_of(tmp_path, program), tmp_path / "out"
    found, again = (scaling([Path("scan")], command=command, bench=Bench(folder=out), threads=3) for _ in range(2))
    assert found["figures"] == again["figures"]
    assert (tmp_path / "runs").read_text() == "1 scan\n3 scan\n"
    figures = found["figures"]
    assert (figures["cpu_s"], figures["serial_s"], figures["serial_share"]) == (10, 2, 0.2)
    assert [figures[f"predicted_{cores}_s"] for cores in (1, 2, 4, 8, 16)] == [10, 6, 4, 3, 3]
    assert figures["peak_mb_threads_1"] == 512.0
    assert figures["wall_s_threads_3"] > 0
    assert "| a | 2 | 10 | 6 | 4 | 3 | 3 |" in found.get("markdown", "")
    assert "| loop 0 | 1 | 8 | 4 | 2 | 1 | 1 |" in found.get("markdown", "")
    command = job_of(tmp_path, "import sys\nsys.exit('eigenhead: no camera sees it')\n")
    with pytest.raises(JobFailed, match="scan could not be reconstructed: eigenhead: no camera sees it"):
        scaling([Path("scan")], command=command, bench=Bench(), threads=1)
