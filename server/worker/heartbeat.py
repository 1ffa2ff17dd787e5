"""Which workers live: who a process is, and whose silence or absence says that it is gone."""

import os
import platform
import secrets
from pathlib import Path

import sqlalchemy as sa

from server.storage.database import now_sql, workers


def dead_workers(engine: sa.Engine, silent_s: float, own: str = "") -> list[str]:
    """Ids of workers that stopped, whose process is gone from this machine, or that are silent for ``silent_s``."""
    machine = process_identity()[0]
    with engine.connect() as connection:
        silent = (workers.c.seen < now_sql(connection) - silent_s).label("silent")
        rows = connection.execute(sa.select(workers, silent).where(workers.c.id != own)).all()
    return [
        row.id
        for row in rows
        if row.stopped is not None
        or row.silent
        or (row.machine == machine and process_started(row.pid) != row.pid_started)
    ]


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
