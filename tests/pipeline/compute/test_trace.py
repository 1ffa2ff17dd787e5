"""A trace is what Chrome's viewer reads: spans that nest thread by thread, of every slice that ran."""

import json
import subprocess
import sys
import threading
import time
from collections import defaultdict
from collections.abc import Sequence
from typing import Any

import numpy as np
import pytest

from pipeline.compute import threads as threads_module
from pipeline.compute.threads import TRACED_THREADS, in_threads, map_in_threads, slice_count, task_pool
from pipeline.compute.trace import FORMAT, Trace, active_trace, name_of, peak_memory_mb, recorded, span, traced

COUNT = 100


@traced
def squares() -> list[int]:
    """Squares a few numbers."""
    return map_in_threads(lambda k: k * k, 5)


def rest(first: int, last: int) -> None:
    time.sleep(0.001)


def document_of(trace: Trace, threads: int) -> dict[str, Any]:
    return json.loads(trace.encoded(threads=threads))


def spans_of(document: dict[str, Any], kind: str) -> list[dict[str, Any]]:
    return [event for event in document["traceEvents"] if event["ph"] == "X" and event["cat"] == kind]


def small_job(threads: int) -> dict[str, Any]:
    trace = Trace()
    with recorded(trace), span("stage", "first"):
        in_threads(COUNT, rest)
        assert squares() == [0, 1, 4, 9, 16]
        with task_pool() as pool:
            assert list(pool.map(len, ["", "a"])) == [0, 1]
    return document_of(trace, threads)


@pytest.fixture(params=[1, 3])
def threads(request: pytest.FixtureRequest, monkeypatch: pytest.MonkeyPatch) -> int:
    monkeypatch.setenv("EIGENHEAD_THREADS", str(request.param))
    return request.param


def test_events_are_complete_and_named(threads: int) -> None:
    document = small_job(threads)
    assert (document["format"], document["threads"]) == (FORMAT, threads)
    assert document["before_cpu_s"] > 0
    events = document["traceEvents"]
    shown = {"pid": int, "tid": int, "ts": (int, float), "dur": (int, float), "name": str, "args": dict}
    for event in (event for event in events if event["ph"] == "X"):
        assert all(isinstance(event[key], kind) for key, kind in shown.items())
        assert event["dur"] >= 0
        assert event["args"]["cpu_s"] >= 0
    names = {event["tid"]: event["args"]["name"] for event in events if event["ph"] == "M"}
    assert names.keys() == {event["tid"] for event in events}
    assert names[threading.get_native_id()] == threading.current_thread().name
    assert [event["name"] for event in spans_of(document, "stage")] == ["first"]
    assert [event["name"] for event in spans_of(document, "part")] == [f"{__name__}.squares"]
    for kind in ("job", "stage", "part"):
        assert all(event["args"]["process_cpu_s"] >= 0 for event in spans_of(document, kind))


def test_spans_of_a_thread_nest(threads: int) -> None:
    by_thread: dict[int, list[tuple[int, int]]] = defaultdict(list)
    for event in small_job(threads)["traceEvents"]:
        if event["ph"] == "X":
            began = round(1000 * event["ts"])
            by_thread[event["tid"]].append((began, began + round(1000 * event["dur"])))
    assert len(by_thread) >= threads
    assert all(nests(spans) for spans in by_thread.values())
    assert not nests([(0, 2), (1, 3)])


def nests(spans: Sequence[tuple[int, int]]) -> bool:
    around: list[tuple[int, int]] = []
    for began, ended in sorted(spans, key=lambda each: (each[0], -each[1])):
        while around and around[-1][1] <= began:
            around.pop()
        if around and ended > around[-1][1]:
            return False
        around.append((began, ended))
    return True


def test_every_slice_of_a_loop_is_there_once(threads: int) -> None:
    document = small_job(threads)
    ranges: dict[int, list[tuple[int, int]]] = defaultdict(list)
    for event in spans_of(document, "slice"):
        ranges[event["args"]["loop"]].append((event["args"].get("first", 0), event["args"].get("last", 0)))
    loops = {event["name"]: event["args"] for event in spans_of(document, "loop")}
    shared, mapped = loops[f"{__name__}.rest"], loops[f"{__name__}.squares"]
    slices = sorted(ranges[shared["loop"]])
    assert len(slices) == slice_count(TRACED_THREADS if threads == 1 else threads)
    assert [first for first, _ in slices] == [0, *(last for _, last in slices[:-1])]
    assert slices[-1][1] == COUNT == shared["count"]
    assert sorted(ranges[mapped["loop"]]) == [(k, k + 1) for k in range(5)]
    assert len(ranges[loops["task_pool"]["loop"]]) == 2


def test_nothing_is_recorded_without_a_trace(threads: int, monkeypatch: pytest.MonkeyPatch) -> None:
    trace = Trace()
    with recorded(trace):
        assert active_trace() is trace
    monkeypatch.setattr(threads_module, "_traced", lambda *_: pytest.fail("a loop was traced"))
    monkeypatch.setattr(Trace, "span", lambda *_: pytest.fail("a span was recorded"))
    with recorded(None), span("stage", "first"):
        assert active_trace() is None
        in_threads(COUNT, rest)
        assert squares() == [0, 1, 4, 9, 16]
        with task_pool() as pool:
            assert list(pool.map(len, ["", "a"])) == [0, 1]
    assert [event["name"] for event in document_of(trace, threads)["traceEvents"] if event["ph"] == "X"] == ["job"]


def test_a_block_that_raises_is_recorded_and_ends_the_trace() -> None:
    trace = Trace()

    def fail() -> None:
        with recorded(trace), span("stage", "first"):
            raise ValueError("of a stage")

    with pytest.raises(ValueError, match="of a stage"):
        fail()
    assert active_trace() is None
    assert [event["cat"] for event in document_of(trace, 1)["traceEvents"] if event["ph"] == "X"] == ["job", "stage"]


def test_processor_seconds_are_a_thread_s_and_the_process_s() -> None:
    def work() -> None:
        until = time.thread_time() + 0.2
        while time.thread_time() < until:
            pass

    trace = Trace()
    with recorded(trace), span("stage", "beside"):
        worker = threading.Thread(target=work)
        worker.start()
        worker.join()
    stage = spans_of(document_of(trace, 1), "stage")[0]["args"]
    assert stage["cpu_s"] < 0.1 < 0.2 <= stage["process_cpu_s"]


def test_a_loop_is_named_by_what_holds_it() -> None:
    def inner(first: int, last: int) -> None: ...

    held = f"{__name__}.test_a_loop_is_named_by_what_holds_it"
    assert {name_of(inner), name_of(lambda: None)} == {held}
    assert name_of(slice_count) == "compute.threads.slice_count"
    assert name_of(squares) == f"{__name__}.squares"


def test_the_memory_of_a_large_parent_is_not_the_childs() -> None:
    held = np.ones(300 << 20, np.uint8)  # ru_maxrss of a child begins with what its parent held
    program = "from pipeline.compute.trace import peak_memory_mb; print(peak_memory_mb())"
    done = subprocess.run([sys.executable, "-c", program], capture_output=True, text=True, check=True, timeout=60)
    assert 1.0 < float(done.stdout) < held.nbytes / (1 << 20) < peak_memory_mb()
