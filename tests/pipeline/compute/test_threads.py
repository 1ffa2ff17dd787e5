"""Every index is worked once, by as many threads as are asked for."""

import os
import re
import threading
import time
from pathlib import Path

import numpy as np
import pytest

from pipeline.compute.threads import SLICES, cut, in_threads, map_in_threads, slice_count, thread_count
from rig.errors import InputError


@pytest.mark.parametrize("threads", ["1", "2", "5"])
@pytest.mark.parametrize("count", [0, 1, 3, 1000])
def test_every_index_is_worked_once(threads: str, count: int, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setenv("EIGENHEAD_THREADS", threads)
    worked = np.zeros(count, int)

    def work(first: int, last: int) -> None:
        worked[first:last] += 1

    in_threads(count, work)
    assert (worked == 1).all()


@pytest.mark.parametrize("threads", [1, 3])
def test_as_many_threads_work_as_are_asked_for(threads: int, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setenv("EIGENHEAD_THREADS", str(threads))
    together, seen = threading.Barrier(threads, timeout=20.0), set()

    def work(first: int, last: int) -> None:
        if threading.get_ident() not in seen:
            seen.add(threading.get_ident())
            together.wait()  # breaks unless that many threads are here at once

    in_threads(SLICES, work)
    assert len(seen) == threads


@pytest.mark.parametrize("count", [0, 1, 7, 8, 30, 1000])
def test_more_threads_cut_the_same_slices_finer(count: int) -> None:
    assert [slice_count(threads) for threads in (1, 2, 4, 8, 9, 16)] == [8, 8, 8, 16, 32, 32]
    coarse, fine = ({first for first, _ in cut(count, slice_count(threads))} for threads in (4, 16))
    assert coarse <= fine
    assert sum(last - first for first, last in cut(count, slice_count(16))) == count


@pytest.mark.parametrize("threads", ["1", "3"])
def test_what_is_mapped_comes_back_in_order(threads: str, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setenv("EIGENHEAD_THREADS", threads)
    assert map_in_threads(lambda k: k * k, 29) == [k * k for k in range(29)]
    assert map_in_threads(lambda k: k, 0) == []


def test_without_the_variable_it_is_a_thread_for_each_cpu(monkeypatch: pytest.MonkeyPatch) -> None:
    for value in (None, "", " "):
        monkeypatch.delenv("EIGENHEAD_THREADS", raising=False)
        if value is not None:
            monkeypatch.setenv("EIGENHEAD_THREADS", value)
        assert thread_count() == len(os.sched_getaffinity(0))


@pytest.mark.parametrize("value", ["0", "-1", "two", "1.5", "513", "9" * 5000, "²"])
def test_what_is_no_number_of_threads_is_refused(value: str, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setenv("EIGENHEAD_THREADS", value)
    with pytest.raises(InputError, match=r"EIGENHEAD_THREADS: the variable is .* whole number from 1 to 512"):
        thread_count()


def test_an_error_of_any_slice_reaches_the_caller(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setenv("EIGENHEAD_THREADS", "3")

    def work(first: int, last: int) -> None:
        raise ValueError("of a slice")

    with pytest.raises(ValueError, match="of a slice"):
        in_threads(100, work)


def test_no_stage_has_a_number_of_threads_of_its_own() -> None:
    """Every pool of the pipeline is as large as EIGENHEAD_THREADS says, but for writing, which waits for the disk."""
    root = Path(__file__).resolve().parents[3] / "pipeline"
    sources = {path.relative_to(root).as_posix(): path.read_text() for path in root.rglob("*.py")}
    pools = re.compile(r"ThreadPoolExecutor\((?!1,)")
    assert [name for name, text in sources.items() if pools.search(text)] == ["compute/threads.py"]
    sizes = {name: set(re.findall(r"with task_pool\((.*?)\) as", text)) for name, text in sources.items()}
    writers = ("results/view_dataset.py", "results/write.py")
    assert {name: found for name, found in sizes.items() if found - {""}} == {key: {"THREADS"} for key in writers}


def test_nobody_still_works_when_an_error_is_told(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setenv("EIGENHEAD_THREADS", "3")
    running: list[int] = []
    together = threading.Barrier(3, timeout=20.0)

    def work(first: int, last: int) -> None:
        running.append(first)
        together.wait()  # all three are at work
        if threading.current_thread() is threading.main_thread():
            running.remove(first)
            raise ValueError("of the caller")
        time.sleep(0.1)
        running.remove(first)

    with pytest.raises(ValueError, match="of the caller"):
        in_threads(3, work)
    assert running == []
