"""Python processes of this package's own code: the worker beside the service, and the children that do heavy work.

They must run this installation's code and no other: a folder named like one of the packages may lie in the working
directory or on PYTHONPATH.
"""

import os
import sys
from contextlib import suppress
from pathlib import Path

M_ARENA_MAX = -8  # of malloc.h
SERVER = __package__ or "server"  # "eigenhead.server" in the wheel


def python_command(module: str, *arguments: str) -> list[str]:
    """The command that runs ``module`` (relative to this package: "cli") with the working directory off the path."""
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
