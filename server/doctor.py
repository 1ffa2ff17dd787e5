"""``eigenhead doctor``: what is wrong with this machine, and what to do about it."""

import os
import shutil
import socket
import sys
from collections.abc import Callable
from typing import Any

import sqlalchemy as sa

from server.access import is_loopback
from server.child import Child, WorkFailed
from server.database import now_sql, open_database, workers
from server.settings import ServiceSettings

MEMORY_LEAST = 2 << 30  # a job takes up to 1.5 GB


def examine(settings: ServiceSettings) -> dict[str, dict[str, Any]]:
    """Findings by name: ``ok`` and a ``detail`` that says what to do."""
    checks: dict[str, Callable[[ServiceSettings], tuple[bool, str]]] = {
        "python": _python,
        "egl": _egl,
        "model": _model,
        "cores": _cores,
        "memory": _memory,
        "data": _data,
        "database": _database,
        "port": _port,
    }
    findings = {}
    for name, check in checks.items():
        try:
            ok, detail = check(settings)
        except Exception as error:  # a check that fails is a finding, not the end of the examination
            ok, detail = False, f"{type(error).__name__}: {error}"
        findings[name] = {"ok": ok, "detail": detail}
    return findings


def _python(settings: ServiceSettings) -> tuple[bool, str]:
    return sys.version_info >= (3, 11), f"{sys.version.split()[0]} (3.11 or newer is needed)"


def _egl(settings: ServiceSettings) -> tuple[bool, str]:
    child = Child()
    try:
        return True, child.run("server.health:try_egl", {})
    except WorkFailed as error:
        return False, error.message
    finally:
        child.close()


def _model(settings: ServiceSettings) -> tuple[bool, str]:
    from pipeline.eigenheads.model import load_model

    model = load_model()
    return True, f"{model.name}, {len(model.modes)} modes, sha256 {model.sha256[:12]}"


def _cores(settings: ServiceSettings) -> tuple[bool, str]:
    count = len(os.sched_getaffinity(0))
    return count >= 2, f"{count}" if count >= 2 else f"{count}: a job and the service share it; expect slow answers"


def _memory(settings: ServiceSettings) -> tuple[bool, str]:
    free = os.sysconf("SC_AVPHYS_PAGES") * os.sysconf("SC_PAGE_SIZE")
    with open("/proc/meminfo") as stream:  # noqa: PTH123
        lines = dict(line.split(":", 1) for line in stream)
    free = max(free, int(lines["MemAvailable"].split()[0]) * 1024)
    need = settings.concurrency * MEMORY_LEAST
    detail = f"{free / 1e9:.1f} GB available"
    return free >= need, detail if free >= need else detail + f"; {settings.concurrency} jobs need {need / 1e9:.1f} GB"


def _data(settings: ServiceSettings) -> tuple[bool, str]:
    settings.data.mkdir(parents=True, exist_ok=True)
    if not os.access(settings.data, os.W_OK):
        return False, f"{settings.data} cannot be written; give it to the user that runs the service"
    free = shutil.disk_usage(settings.data).free
    detail = f"{settings.data}, {free / 1e9:.1f} GB free"
    return free > settings.free_bytes, detail if free > settings.free_bytes else detail + ": delete captures or jobs"


def _database(settings: ServiceSettings) -> tuple[bool, str]:
    engine = open_database(settings)
    with engine.connect() as connection:
        alive = workers.c.seen > now_sql(connection) - settings.silent_s
        count = connection.scalar(sa.select(sa.func.count()).where(alive, workers.c.stopped.is_(None)))
        kind = engine.dialect.name
        if kind == "sqlite" and connection.scalar(sa.text("PRAGMA quick_check(1)")) != "ok":
            return False, f"{settings.url} is damaged: stop the service, keep the file, and restore a copy of it"
    engine.dispose()
    return True, f"{kind}, {count} workers alive"


def _port(settings: ServiceSettings) -> tuple[bool, str]:
    if not is_loopback(settings.host):
        return True, f"{settings.host}:{settings.port}, for callers with an API key"
    with socket.socket(socket.AF_INET6 if ":" in settings.host else socket.AF_INET) as sock:
        taken = sock.connect_ex((settings.host, settings.port)) == 0
    return True, f"{settings.host}:{settings.port}" + (", in use: is the service running?" if taken else ", free")
