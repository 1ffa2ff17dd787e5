"""Compiles numerical loops ahead (those in ``pipeline.compute.kernel_list``), in several processes, so that no job
waits for them.

The installation compiles the loops (``eigenhead prepare``). A command first compiles a loop that it finds missing.
"""

import errno
import logging
import os
import shutil
import tempfile
import threading
from collections import deque
from concurrent.futures import ThreadPoolExecutor
from contextlib import closing
from typing import TYPE_CHECKING, NamedTuple

from rig.files import cache_folder
from rig.progress import Progress
from server.tasks.child import Child, WorkerContext

if TYPE_CHECKING:
    from pipeline.compute.kernel_list import Kernel
    from pipeline.settings import Settings

log = logging.getLogger("eigenhead")
FREE_LEAST = 16 << 20  # bytes of disk: the list takes 6 MB, and arrays come after it
PROCESSES_MOST = 8  # each takes 250 MB and half a second to load what it compiles


class Prepared(NamedTuple):
    """Holds how many numerical loops were compiled now, are still missing, and are listed in all."""

    compiled: int  # now
    missing: int  # still: nothing can be kept
    known: int


def compile_kernel(context: WorkerContext, report: Progress, *, line: str) -> bool:
    """Compiles the loop that a line of the list names, in a child process. Returns whether the code could be stored on
    disk; if not, a log line says so."""
    from pipeline.compute.kernel_list import Kernel

    kernel = Kernel.from_line(line)
    kernel.compile()
    return kernel.is_kept()


def prepare_kernels(report: Progress, settings: "Settings | None" = None) -> Prepared:
    """Compiles the listed loops that the cache folder lacks, in several processes, and logs one line about it.

    If the cache folder cannot be written, this is logged and nothing is compiled: each process will compile for itself.
    ``report`` is called with "compiling 12 of 49 loops" and the fraction done, from several threads, one at a time; its
    exceptions end the work, and loops compiled until then are kept. Loops that a job of the ``settings`` does not call
    are left out. Returns how many loops were compiled, are missing, and are listed."""
    from pipeline.compute.kernel_list import by_module, listed_kernels
    from pipeline.settings import FINE_LEVELS

    dense = settings is None or settings.detail in FINE_LEVELS or settings.outputs.surface != "head"
    kernels = listed_kernels(dense=dense)
    missing = [kernel for kernel in kernels if not kernel.is_kept()]
    if not missing or not _can_keep():
        return Prepared(0, len(missing), len(kernels))
    log.warning("compiling what a job calls (loops: %d), once for this machine and version", len(missing))
    groups = sorted(by_module(missing), key=lambda group: sum(kernel.size() for kernel in group), reverse=True)
    work = _Work(groups, len(missing), report)
    work.advance(0)
    count = min(len(os.sched_getaffinity(0)), len(groups), PROCESSES_MOST)
    with ThreadPoolExecutor(count, thread_name_prefix="compile") as pool:
        for done in [pool.submit(work.compile_groups) for _ in range(count)]:
            done.result()
    return Prepared(work.done, len(missing) - work.done, len(kernels))


class _Work:
    """Distributes groups of kernels to several threads, each of which has a child process."""

    def __init__(self, groups: "list[list[Kernel]]", total: int, report: Progress) -> None:
        self._groups, self._total, self._report = deque(groups), total, report
        self._lock = threading.Lock()
        self.done = 0

    def compile_groups(self) -> None:
        try:
            with closing(Child()) as child:
                while self._groups:
                    try:
                        group = self._groups.popleft()
                    except IndexError:  # another was quicker
                        return
                    for kernel in group:
                        if not child.remote(compile_kernel)(line=kernel.line):
                            self._groups.clear()  # a full disk: going on would make what nobody finds again
                            return
                        self.advance(1)
        except BaseException:
            self._groups.clear()
            raise

    def advance(self, more: int) -> None:
        with self._lock:
            self.done += more
            self._report(f"compiling {self.done} of {self._total} loops", self.done / self._total)


def _can_keep() -> bool:
    """Returns whether the cache folder can be written; if not, a log line says so."""
    from rig.jit import say_not_kept

    try:
        folder = cache_folder() / "kernels"
        folder.mkdir(parents=True, exist_ok=True)
        with tempfile.TemporaryFile(dir=folder):
            if shutil.disk_usage(folder).free < FREE_LEAST:
                raise OSError(errno.ENOSPC, os.strerror(errno.ENOSPC))
            return True
    except OSError as error:
        say_not_kept(error)
        return False
