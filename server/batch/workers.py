"""Computes how many captures are reconstructed at once, from the memory and processors that this process may use."""

import os
from pathlib import Path

WORKER_BYTES = 2 << 30  # memory of one worker
"""Memory of a worker: 1.4 GB at the most in a default job of eleven cameras of 1024 x 768 (VmHWM of `eigenhead
reconstruct scan-a`), and half as much again for larger pictures."""
CGROUP = Path("/sys/fs/cgroup")


def worker_count(cores: int, free_bytes: int, captures: int) -> int:
    """Computes the default number of workers: one for each core, as far as memory allows, and at least one."""
    return max(1, min(cores, free_bytes // WORKER_BYTES, captures))


def threads_of_worker(cores: int, workers: int) -> int:
    """Computes how many threads each worker's loops may use, so that all workers together use every core once."""
    return max(1, cores // workers)


def usable_cores() -> int:
    """Returns how many processors this process may use."""
    return len(os.sched_getaffinity(0))


def free_memory(meminfo: Path = Path("/proc/meminfo"), cgroup: Path | None = None) -> int:
    """Returns the free bytes of memory: of the machine, or of this process's control groups (such as a container's) if
    these have less."""
    free = [_available(meminfo)]
    group = _own_group() if cgroup is None else cgroup
    while group.is_relative_to(CGROUP) or cgroup is not None:
        limit, used = _number(group / "memory.max"), _number(group / "memory.current")
        if limit is not None and used is not None:
            free.append(max(0, limit - used))
        if cgroup is not None or group == CGROUP:
            break
        group = group.parent
    return min(free)


def _available(meminfo: Path) -> int:
    try:
        lines = dict(line.split(":", 1) for line in meminfo.read_text().splitlines())
        return int(lines["MemAvailable"].split()[0]) * 1024
    except (OSError, ValueError, KeyError):
        return WORKER_BYTES


def _own_group() -> Path:
    """Returns the folder of this process's control group, version 2."""
    try:
        lines = Path("/proc/self/cgroup").read_text().splitlines()
    except OSError:
        return CGROUP
    group = next((line[3:] for line in lines if line.startswith("0::")), "/")
    return CGROUP / group.lstrip("/")


def _number(path: Path) -> int | None:
    """Returns the number in a file; None for "max", and if the file does not exist."""
    try:
        return int(path.read_text())
    except (OSError, ValueError):
        return None
