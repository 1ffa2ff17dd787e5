"""Starts Python processes that run this package's own code, and identifies processes: the worker beside the service,
and the children that do heavy work.

Started processes must run this installation's code, even if a folder with the name of one of its packages lies in the
working directory or on PYTHONPATH.
"""

import gc
import os
import platform
import secrets
import signal
import sys
from contextlib import suppress
from pathlib import Path

from rig.progress import Progress

M_ARENA_MAX, M_TRIM_THRESHOLD, M_MMAP_THRESHOLD = -8, -1, -3  # of malloc.h
PR_SET_PDEATHSIG = 1  # of sys/prctl.h
SERVER = __package__ or "server"  # "eigenhead.server" in the wheel


def python_command(module: str, *arguments: str) -> list[str]:
    """Returns the command that runs a module of this package (such as "cli") without the working directory on Python's
    path."""
    return [sys.executable, "-P", "-m", f"{SERVER}.{module}", *arguments]


def python_environment() -> dict[str, str]:
    """Returns this process's environment variables, with the checkout put before everything else on PYTHONPATH.

    If the program was installed from a wheel, the variables stay unchanged, because the package has a unique name.
    """
    if "." in SERVER:
        return dict(os.environ)
    checkout = str(Path(__file__).resolve().parents[1])
    others = [folder for folder in os.environ.get("PYTHONPATH", "").split(os.pathsep) if folder not in ("", checkout)]
    return os.environ | {"PYTHONPATH": os.pathsep.join([checkout, *others])}


def share_one_heap() -> None:
    """Makes all threads of this process share one heap, if the C library is glibc; call this before any thread starts.

    By default each thread has its own heap, and other threads cannot reuse its freed memory. With such heaps a default
    job needs 150 MB more. Garbage collection, which by default takes 1.5 of 31 CPU s, also becomes rarer.
    """
    import ctypes

    gc.set_threshold(100_000, 10, 10)
    with suppress(AttributeError):
        ctypes.CDLL(None).mallopt(M_ARENA_MAX, 1)


def tidied(report: Progress) -> Progress:
    """Returns ``report``, extended for a job: whenever a stage begins, unused pages of this process's heap are returned
    to the system, which takes milliseconds and needs glibc.

    Otherwise glibc would keep freed memory below existing arrays: 110 MB after a default job's depth maps.
    """
    import ctypes

    def tell(stage: str, fraction: float) -> None:
        if not fraction:
            with suppress(AttributeError):
                ctypes.CDLL(None).malloc_trim(0)
        report(stage, fraction)

    return tell


def process_identity() -> tuple[str, str, int, int]:
    """Returns a unique identity of this process: machine (boot and pid namespace), host name, pid, and start time in
    clock ticks after boot."""
    try:
        boot = Path("/proc/sys/kernel/random/boot_id").read_text().strip()
        machine = f"{boot}/{Path('/proc/self/ns/pid').readlink()}"
    except OSError:  # no /proc: then only silence tells
        machine = f"{platform.node()}/{secrets.token_hex(8)}"
    return machine, platform.node(), os.getpid(), process_started(os.getpid())


def process_started(pid: int) -> int:
    """Returns when a process started, in clock ticks after boot (field 22 of /proc/<pid>/stat); 0 if there is no such
    process."""
    try:
        fields = Path(f"/proc/{pid}/stat").read_text().rpartition(")")[2].split()
    except OSError:
        return 0
    return 0 if fields[0] in ("Z", "X") else int(fields[19])


def end_with_parent(parent: int) -> None:
    """Makes the kernel kill this process when the thread that started it ends; ``parent`` is that thread's process.

    A child process would otherwise continue to write and to hold memory after a SIGKILL of its parent. Works on Linux
    only.
    """
    import ctypes

    with suppress(AttributeError):
        ctypes.CDLL(None).prctl(PR_SET_PDEATHSIG, signal.SIGKILL, 0, 0, 0)
    if os.getppid() != parent:  # it ended before
        os._exit(1)
