"""``eigenhead doctor``: what is wrong with this machine, and what to do about it."""

import difflib
import os
import shutil
import socket
import sys
from collections.abc import Callable
from pathlib import Path
from typing import Any
from urllib.parse import quote

import sqlalchemy as sa

from pipeline.eigenheads.data_folder import MODELS, models_folder
from pipeline.parallel_for import THREADS, thread_count
from rig.errors import EigenheadError
from server.address import is_loopback
from server.settings import PREFIX, ServiceSettings
from server.storage.database import alive_workers, api_keys, workers
from server.tasks.child import Child, WorkFailed
from server.tasks.egl import try_egl

OTHER_VARIABLES = frozenset(
    {MODELS, THREADS, PREFIX + "DEBUG", PREFIX + "CACHE"}
)  # read elsewhere than in ServiceSettings
MEMORY_LEAST = 2 << 30  # a job takes up to 1.5 GB


def examine(settings: ServiceSettings) -> dict[str, dict[str, Any]]:
    """Findings by name: ``ok`` and a ``detail`` that says what to do. Looks, and makes nothing."""
    checks: dict[str, Callable[[ServiceSettings], tuple[bool, str]]] = {
        "python": _python,
        "egl": _egl,
        "model": _model,
        "cores": _cores,
        "memory": _memory,
        "data": _data,
        "models": _models,
        "database": _database,
        "variables": _variables,
        "rig": _rig,
        "port": _port,
    }
    findings = {}
    for name, check in checks.items():
        try:
            ok, detail = check(settings)
        except Exception as error:  # a check that fails is a finding, not the end of the examination
            told = str(error) if isinstance(error, EigenheadError) else f"{type(error).__name__}: {error}"
            ok, detail = False, told
        findings[name] = {"ok": ok, "detail": detail}
    return findings


def _python(settings: ServiceSettings) -> tuple[bool, str]:
    return sys.version_info >= (3, 11), f"{sys.version.split()[0]} (3.11 or newer is needed)"


def _egl(settings: ServiceSettings) -> tuple[bool, str]:
    child = Child()
    try:
        return True, child.remote(try_egl)()
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
    threads = thread_count()
    used = f"{count}" if threads == count else f"{count}; {THREADS} gives a job's loops {threads} threads"
    return count >= 2, used if count >= 2 else f"{used}: a job and the service share it; expect slow answers"


def _memory(settings: ServiceSettings) -> tuple[bool, str]:
    free = os.sysconf("SC_AVPHYS_PAGES") * os.sysconf("SC_PAGE_SIZE")
    with open("/proc/meminfo") as stream:  # noqa: PTH123
        lines = dict(line.split(":", 1) for line in stream)
    free = max(free, int(lines["MemAvailable"].split()[0]) * 1024)
    need = settings.concurrency * MEMORY_LEAST
    detail = f"{free / 1e9:.1f} GB available"
    return free >= need, detail if free >= need else detail + f"; {settings.concurrency} jobs need {need / 1e9:.1f} GB"


def _data(settings: ServiceSettings) -> tuple[bool, str]:
    there = next(folder for folder in (settings.data.resolve(), *settings.data.resolve().parents) if folder.exists())
    if not (there.is_dir() and os.access(there, os.W_OK)):
        return False, f"{there} cannot be written; give it to the user that runs the service"
    free = shutil.disk_usage(there).free
    detail = f"{settings.data.resolve()}, {free / 1e9:.1f} GB free"
    detail += "" if there == settings.data.resolve() else "; `eigenhead serve` will make it"
    return free > settings.free_bytes, detail if free > settings.free_bytes else detail + ": delete captures or jobs"


def _models(settings: ServiceSettings) -> tuple[bool, str]:
    count = len(list(models_folder().glob("*.npz")))
    return True, f"{models_folder()}, {count} of your own beside the default" if count else f"{models_folder()}, empty"


def _database(settings: ServiceSettings) -> tuple[bool, str]:
    """Reads it where there is one."""
    url = sa.make_url(settings.url)
    kind = url.get_backend_name()
    if kind == "sqlite":
        path = Path(str(url.database))
        if not path.is_file():
            return True, f"{path}, `eigenhead serve` will make it; no API key"
        closed = not path.with_name(path.name + "-wal").exists()  # then a reader need not make one
        url = sa.make_url(f"sqlite:///file:{quote(str(path))}?mode=ro&immutable={int(closed)}&uri=true")
    engine = sa.create_engine(url, connect_args={"timeout" if kind == "sqlite" else "connect_timeout": 10})
    try:
        with engine.connect() as connection:
            if kind == "sqlite" and connection.scalar(sa.text("PRAGMA quick_check(1)")) != "ok":
                return False, f"{settings.place} is damaged: stop the service, keep the file, and restore a copy of it"
            if not sa.inspect(connection).has_table(workers.name):
                return True, f"{settings.place}, empty: `eigenhead serve` will make its tables"
            alive = alive_workers(connection, settings.silent_s)
            count = connection.scalar(sa.select(sa.func.count()).where(alive))
            keys = connection.scalar(sa.select(sa.func.count()).select_from(api_keys))
    finally:
        engine.dispose()
    return True, f"{settings.place}, {count} workers alive, {keys} API keys"


def _variables(settings: ServiceSettings) -> tuple[bool, str]:
    """Names the variables of ours that nobody reads."""
    known = {PREFIX + name.upper() for name in ServiceSettings.model_fields} | OTHER_VARIABLES
    given = sorted(name for name in os.environ if name.startswith(PREFIX))
    faults = []
    for name in given:
        if name not in known:
            near = difflib.get_close_matches(name, known, n=1)
            faults.append(f"{name} is not known" + (f"; did you mean {near[0]}?" if near else ""))
    return not faults, "; ".join(faults) or ", ".join(given) or "none set"


def _rig(settings: ServiceSettings) -> tuple[bool, str]:
    if settings.rig is None:
        return True, "the simulated studio; --rig or EIGENHEAD_RIG names real cameras"
    from rig.formats.rig_toml import read_rig_config

    return True, f"{settings.rig}, {len(read_rig_config(settings.rig).cameras)} cameras; see `eigenhead rig check`"


def _port(settings: ServiceSettings) -> tuple[bool, str]:
    if not is_loopback(settings.host):
        return True, f"{settings.host}:{settings.port}, for callers with an API key"
    with socket.socket(socket.AF_INET6 if ":" in settings.host else socket.AF_INET) as sock:
        taken = sock.connect_ex((settings.host, settings.port)) == 0
    return True, f"{settings.host}:{settings.port}" + (", in use: is the service running?" if taken else ", free")
