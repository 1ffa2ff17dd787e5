"""Implements ``eigenhead doctor``: finds what is wrong with this machine and says what to do about it."""

import json
import os
import shutil
import socket
import sqlite3
import sys
import time
from contextlib import closing
from pathlib import Path
from typing import Any
from urllib.parse import quote

from pipeline.compute.threads import THREADS, thread_count
from pipeline.head_model.model_names import MODELS, model_path, models_folder
from rig.errors import EigenheadError
from rig.files import CACHE, cache_folder, sha256_of
from rig.text import suggest
from server.address import is_loopback
from server.settings import PREFIX, ServiceSettings
from server.storage.folders import STOPPED
from server.tasks.child import Child, WorkFailed
from server.tasks.egl import try_compute, try_egl

OTHER_VARIABLES = frozenset({MODELS, THREADS, PREFIX + "DEBUG", CACHE})  # valid, but not fields of ServiceSettings
# Queries for the tables of server.storage.database and of the job engine in plain SQL: importing SQLAlchemy takes
# longer than all checks.
TABLES = {
    "sqlite": "SELECT name FROM sqlite_master WHERE name = '{}'",
    "postgresql": "SELECT tablename FROM pg_tables WHERE tablename = '{}'",
}
JOBS = {"sqlite": "workflow_status", "postgresql": "dbos.workflow_status"}
NOW = {"sqlite": "((julianday('now') - 2440587.5) * 86400.0)", "postgresql": "extract(epoch from clock_timestamp())"}
STORE_S = 3.0  # how long doctor waits for a store at most
COMPARE_S = 30.0  # how long doctor compares files of results
MEMORY_LEAST = 2 << 30  # a job takes up to 1.5 GB


def examine(settings: ServiceSettings) -> dict[str, dict[str, Any]]:
    """Runs every check of this machine. Returns by name whether the check passed (``ok``) and its finding or remedy
    (``detail``). The checks make neither folders nor database tables."""
    checks = (
        *(_python, _egl, _gpu, _model, _cores, _memory, _data, _models, _cache, _database, _retention, _results),
        *(_variables, _rig, _stores, _port),
    )
    findings = {}
    for check in checks:
        try:
            ok, detail = check(settings)
        except Exception as error:  # a check that fails is a finding, not the end of the examination
            ok, detail = False, str(error) if isinstance(error, EigenheadError) else f"{type(error).__name__}: {error}"
        findings[check.__name__.removeprefix("_")] = {"ok": ok, "detail": detail}
    return findings


def _python(settings: ServiceSettings) -> tuple[bool, str]:
    return sys.version_info >= (3, 11), f"{sys.version.split()[0]} (3.11 or newer is needed)"


def _egl(settings: ServiceSettings) -> tuple[bool, str]:
    with closing(Child()) as child:
        try:
            return True, child.remote(try_egl)()
        except WorkFailed as error:
            return False, error.message.text


def _gpu(settings: ServiceSettings) -> tuple[bool, str]:
    with closing(Child()) as child:
        try:
            return True, child.remote(try_compute)()
        except WorkFailed as error:
            return True, f"none: {error.message.text}"  # no fault: the processor computes instead


def _model(settings: ServiceSettings) -> tuple[bool, str]:
    from pipeline.head_model.model_file import read_parts

    parts, sha256 = read_parts(model_path("default"))
    return True, f"{parts.name}, {len(parts.modes)} modes, sha256 {sha256[:12]}"


def _cores(settings: ServiceSettings) -> tuple[bool, str]:
    count = len(os.sched_getaffinity(0))
    threads = thread_count()
    used = f"{count}" if threads == count else f"{count}; {THREADS} gives a job's loops {threads} threads"
    return count >= 2, used if count >= 2 else f"{used}: a job and the service share it; expect slow answers"


def _memory(settings: ServiceSettings) -> tuple[bool, str]:
    free = os.sysconf("SC_AVPHYS_PAGES") * os.sysconf("SC_PAGE_SIZE")
    with Path("/proc/meminfo").open() as stream:
        lines = dict(line.split(":", 1) for line in stream)
    free = max(free, int(lines["MemAvailable"].split()[0]) * 1024)
    need = settings.concurrency * MEMORY_LEAST
    detail = f"{free / 1e9:.1f} GB available"
    return free >= need, detail if free >= need else detail + f"; {settings.concurrency} jobs need {need / 1e9:.1f} GB"


def _data(settings: ServiceSettings) -> tuple[bool, str]:
    existing = next(folder for folder in (settings.data.resolve(), *settings.data.resolve().parents) if folder.exists())
    if not (existing.is_dir() and os.access(existing, os.W_OK)):
        return False, f"{existing} cannot be written; give it to the user that runs the service"
    free = shutil.disk_usage(existing).free
    held = (f"{len(list((settings.data / name).glob('*')))} {name}" for name in ("captures", "jobs"))
    detail = f"{settings.data.resolve()}, {', '.join(held)}, {free / 1e9:.1f} GB free"
    detail += "" if existing == settings.data.resolve() else "; `eigenhead serve` will make it"
    return free > settings.free_bytes, detail if free > settings.free_bytes else detail + ": delete captures or jobs"


def _models(settings: ServiceSettings) -> tuple[bool, str]:
    count = len(list(models_folder().glob("*.npz")))
    return True, f"{models_folder()}, {count} of your own beside the default" if count else f"{models_folder()}, empty"


def _cache(settings: ServiceSettings) -> tuple[bool, str]:
    folder = cache_folder().resolve()
    existing = next(place for place in (folder, *folder.parents) if place.exists())
    if not (existing.is_dir() and os.access(existing, os.W_OK)):
        return False, f"{folder} cannot be written: every start compiles anew; {CACHE} names another folder"
    return True, f"{folder}, what can be made again" + ("" if existing == folder else "; not made yet")


def _database(settings: ServiceSettings) -> tuple[bool, str]:
    """Checks that the database can be read, if there is one."""
    kind = _kind(settings)
    connection = _connected(settings)
    if connection is None:
        left = " and ".join(name for name in ("captures", "jobs") if any((settings.data / name).glob("*")))
        if left:
            return False, f"{_sqlite(settings)} is not there, but {left} are: restore its copy beside them"
        return True, f"{_sqlite(settings)}, `eigenhead serve` will make it; no API key"
    with closing(connection):
        if kind == "sqlite" and _rows(connection, "PRAGMA quick_check(1)") != [("ok",)]:
            return False, f"{settings.place} is damaged: stop the service, keep the file, and restore a copy of it"
        if not _rows(connection, TABLES[kind].format("eigenhead_workers")):
            return True, f"{settings.place}, empty: `eigenhead serve` will make its tables"
        alive = (
            f"SELECT count(*) FROM eigenhead_workers WHERE stopped IS NULL AND seen > {NOW[kind]} - {settings.silent_s}"
        )
        ((count,),) = _rows(connection, alive)
        ((keys,),) = _rows(connection, "SELECT count(*) FROM eigenhead_api_keys")
    workers = f"{count} worker{'s' * (count != 1)} seen in the last {settings.silent_s:.0f} s"
    return True, f"{settings.place}, {workers}, {keys} API key{'s' * (keys != 1)}"


def _results(settings: ServiceSettings) -> tuple[bool, str]:
    """Compares the result files of succeeded jobs with their records, newest first, for ``COMPARE_S`` seconds. The
    check names changed files, and jobs without a result folder (removed by hand, or missing in a restored backup)."""
    kind = _kind(settings)
    connection = _connected(settings)
    if connection is None:
        return True, "none yet"
    with closing(connection):
        if not _rows(connection, TABLES[kind].format("workflow_output")):
            return True, "none yet"
        outputs = JOBS[kind].replace("status", "output")
        query = f"SELECT job.workflow_uuid, made.output FROM {JOBS[kind]} AS job LEFT JOIN {outputs} AS made"
        query += " ON made.workflow_uuid = job.workflow_uuid WHERE job.name = 'reconstruct' AND job.status = 'SUCCESS'"
        rows = _rows(connection, query + " ORDER BY job.created_at DESC")
    missing = [job for job, _ in rows if not (settings.data / "jobs" / job / "result").is_dir()]
    damaged, compared, end = list[str](), 0, time.monotonic() + COMPARE_S
    for job, output in rows:
        if job not in missing and str(output).startswith("{") and time.monotonic() < end:  # not an older, pickled one
            compared += 1
            damaged += _damaged(settings.data / "jobs" / job, json.loads(output))
    if damaged:
        return False, f"changed since their jobs made them: {', '.join(damaged[:5])}; restore them, or restart the jobs"
    if not missing:
        return True, f"of {len(rows)} jobs, all there; the files of {compared} were compared"
    gone = f"{len(missing)} are gone ({', '.join(missing[:3])}{' ...' if len(missing) > 3 else ''})"
    return False, f"of {len(rows)} jobs {gone}: restore `jobs` from a backup, or restart them"


def _damaged(folder: Path, files: dict[str, dict[str, str]]) -> list[str]:
    found = ((folder / "result" / name, entry["sha256"]) for name, entry in files.items())
    there = ((path, sha256) for path, sha256 in found if path.is_file())  # the others may lie in a store
    return [f"{folder.name}/{path.name}" for path, sha256 in there if sha256_of(path) != sha256]


def _retention(settings: ServiceSettings) -> tuple[bool, str]:
    stopped = settings.data / STOPPED
    return not stopped.exists(), stopped.read_text(encoding="utf-8") if stopped.exists() else "the clock is trusted"


def _kind(settings: ServiceSettings) -> str:
    return "sqlite" if settings.url.startswith("sqlite:") else "postgresql"


def _connected(settings: ServiceSettings) -> Any:
    """Opens the database for reading (a connection of PEP 249); returns None if SQLite's file does not exist."""
    if _kind(settings) == "sqlite":
        return _read_only(_sqlite(settings)) if _sqlite(settings).is_file() else None
    import psycopg

    return psycopg.connect(f"postgresql://{settings.url.partition('://')[2]}", connect_timeout=10)


def _sqlite(settings: ServiceSettings) -> Path:
    return Path(settings.url.removeprefix("sqlite:///"))


def _rows(connection: Any, query: str) -> list[tuple[Any, ...]]:
    cursor = connection.cursor()
    cursor.execute(query)
    return cursor.fetchall()


def _read_only(path: Path) -> sqlite3.Connection:
    closed = not path.with_name(path.name + "-wal").exists()  # without a -wal file a reader must not create one
    return sqlite3.connect(f"file:{quote(str(path))}?mode=ro&immutable={int(closed)}", uri=True, timeout=10)


def _variables(settings: ServiceSettings) -> tuple[bool, str]:
    """Names environment variables with the project's prefix that the program does not read, such as misspelt ones."""
    known = {PREFIX + name.upper() for name in ServiceSettings.model_fields} | OTHER_VARIABLES
    present = sorted(name for name in os.environ if name.startswith(PREFIX))
    faults = []
    for name in present:
        if name not in known:
            near = suggest(name, known)
            faults.append(f"{name} is not known" + (f"; did you mean {near[0]}?" if near else ""))
    return not faults, "; ".join(faults) or ", ".join(present) or "none set"


def _rig(settings: ServiceSettings) -> tuple[bool, str]:
    if settings.rig is None:
        return True, "the simulated studio; --rig or EIGENHEAD_RIG names real cameras"
    from rig.formats.rig_toml import read_rig_config

    return True, f"{settings.rig}, {len(read_rig_config(settings.rig).cameras)} cameras; see `eigenhead rig check`"


def _stores(settings: ServiceSettings) -> tuple[bool, str]:
    """Lists the first object of each object store; whether the service may write there, only a delivery shows."""
    stores = [place for place in (settings.captures_store, settings.results_store) if place is not None]
    places = dict.fromkeys([*settings.import_prefixes, *settings.deliver_prefixes, *stores])
    if not places:
        return True, "none; EIGENHEAD_IMPORT_PREFIXES and EIGENHEAD_DELIVER_PREFIXES name places"
    from server.storage.object_places import open_objects

    faults, hasty = [], settings.model_copy(update={"store_timeout_s": min(settings.store_timeout_s, STORE_S)})
    for store in places:
        try:
            next(iter(open_objects(store, hasty).entries("")), None)
        except EigenheadError as error:
            faults.append(str(error))
    return not faults, " ".join(faults) or f"{', '.join(places)}: answer"


def _port(settings: ServiceSettings) -> tuple[bool, str]:
    if not is_loopback(settings.host):
        return True, f"{settings.host}:{settings.port}, for callers with an API key"
    with socket.socket(socket.AF_INET6 if ":" in settings.host else socket.AF_INET) as sock:
        taken = sock.connect_ex((settings.host, settings.port)) == 0
    return True, f"{settings.host}:{settings.port}" + (", in use: is the service running?" if taken else ", free")
