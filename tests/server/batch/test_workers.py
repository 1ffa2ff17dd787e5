"""As many workers as cores and memory carry."""

from pathlib import Path

import pytest

from server.batch.workers import WORKER_BYTES, free_memory, threads_of_worker, usable_cores, worker_count

GB = 1 << 30


@pytest.mark.parametrize(
    ("cores", "free_gb", "captures", "count"),
    [(8, 64, 100, 8), (64, 20, 100, 10), (8, 64, 3, 3), (2, 1, 100, 1), (1, 64, 0, 1)],
)
def test_workers_by_cores_memory_and_captures(cores: int, free_gb: int, captures: int, count: int) -> None:
    assert worker_count(cores, free_gb * GB, captures) == count


@pytest.mark.parametrize(("cores", "workers", "threads"), [(8, 8, 1), (8, 2, 4), (8, 3, 2), (2, 4, 1)])
def test_threads_fill_the_cores(cores: int, workers: int, threads: int) -> None:
    assert threads_of_worker(cores, workers) == threads


def test_a_schedulers_limit_counts_where_it_is_less(tmp_path: Path) -> None:
    meminfo = tmp_path / "meminfo"
    meminfo.write_text("MemTotal: 33554432 kB\nMemAvailable: 16777216 kB\n")
    assert free_memory(meminfo, tmp_path) == 16 * GB
    (tmp_path / "memory.max").write_text("max\n")
    (tmp_path / "memory.current").write_text(f"{3 * GB}\n")
    assert free_memory(meminfo, tmp_path) == 16 * GB
    (tmp_path / "memory.max").write_text(f"{8 * GB}\n")
    assert free_memory(meminfo, tmp_path) == 5 * GB
    assert free_memory(tmp_path / "none", tmp_path) == WORKER_BYTES


def test_this_machine_has_some_of_both() -> None:
    assert usable_cores() >= 1
    assert 0 < free_memory() < 1 << 60
