"""Python processes of this package's own code: the worker beside the service, and the children that do heavy work; and
who a process is.

They must run this installation's code and no other: a folder named like one of the packages may lie in the working
directory or on PYTHONPATH.
"""

import os
import platform
import secrets
import signal
import sys
from contextlib import suppress
from pathlib import Path

M_ARENA_MAX = -8  # of malloc.h
PR_SET_PDEATHSIG = 1  # of sys/prctl.h
SERVER = __package__ or "server"  # "eigenhead.server" in the wheel


def python_command(module: str, *arguments: str) -> list[str]:
    """Returns the command that runs ``module`` (relative to this package: "cli") with the working directory off the
    path."""
    return [sys.executable, "-P", "-m", f"{SERVER}.{module}", *arguments]


def python_environment() -> dict[str, str]:
    """This process's variables, with the checkout before everything else that PYTHONPATH names.

    The wheel's packages lie under a name of their own, which needs no such care.
    """
    if "." in SERVER:
        return dict(os.environ)
    checkout = str(Path(__file__).resolve().parents[1])
    others = [folder for folder in os.environ.get("PYTHONPATH", "").split(os.pathsep) if folder not in ("", checkout)]
    return os.environ | {"PYTHONPATH": os.pathsep.join([checkout, *others])}


def share_one_heap() -> None:
    """Has all threads of this process use one heap, where the C library is glibc; to be called before there are any.

    By default each has its own, and none gives what it has free to the others: a default job then holds 150 MB more,
    and takes as many seconds.
    """
    import ctypes

    with suppress(AttributeError):
        ctypes.CDLL(None).mallopt(M_ARENA_MAX, 1)


def process_identity() -> tuple[str, str, int, int]:
    """(machine: boot and pid namespace, host name, pid, the pid's start time in clock ticks after boot)."""
    try:
        boot = Path("/proc/sys/kernel/random/boot_id").read_text().strip()
        machine = f"{boot}/{Path('/proc/self/ns/pid').readlink()}"
    except OSError:  # no /proc: then only silence tells
        machine = f"{platform.node()}/{secrets.token_hex(8)}"
    return machine, platform.node(), os.getpid(), process_started(os.getpid())


def process_started(pid: int) -> int:
    """Field 22 of /proc/<pid>/stat (proc(5)); 0 where there is no such process."""
    try:
        fields = Path(f"/proc/{pid}/stat").read_text().rpartition(")")[2].split()
    except OSError:
        return 0
    return 0 if fields[0] in ("Z", "X") else int(fields[19])


def end_with_parent(parent: int) -> None:
    """Has the kernel kill this process when the thread that started it ends, ``parent`` being that thread's process:
    what a SIGKILL leaves behind would go on writing, and hold its memory. Linux alone knows how."""
    import ctypes

    with suppress(AttributeError):
        ctypes.CDLL(None).prctl(PR_SET_PDEATHSIG, signal.SIGKILL, 0, 0, 0)
    if os.getppid() != parent:  # it ended before
        os._exit(1)
