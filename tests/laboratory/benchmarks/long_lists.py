"""How long every list takes with a hundred thousand captures, two hundred thousand jobs and five hundred batches.

python -m tests.laboratory long_lists --captures 5000 --jobs 10000 --rounds 20 --postgres

A database and a data folder are filled behind the service's back (records without pictures, the engine's rows copied
from one real job), then a service is started and its lists are asked for over HTTP, each so many rounds; the figures
are the median, the 95th percentile and the slowest. With ``--postgres`` the same on a PostgreSQL started here.
``--keep`` fills FOLDER once and uses it again.
"""

import base64
import json
import pickle
import time
from collections.abc import Iterator
from contextlib import ExitStack
from pathlib import Path
from typing import Any

import httpx
import numpy as np
import sqlalchemy as sa

from server.services.jobs import Jobs, migrate
from server.services.work import ReconstructionRequest
from server.settings import ServiceSettings
from server.storage.database import batch_items, batches, job_index, open_database
from server.storage.job_index import words_of_job
from server.storage.library import Library
from server.storage.records import CAPTURE, SESSION, CameraSize, CaptureRecord, SessionRecord
from server.storage.store import Store
from tests.support.postgres import running_postgres
from tests.support.services import running_service

AT_ONCE = 2000
CAPTURES_A_SESSION = 5
QUEUED, RUNNING = 300, 2
EPOCH_MS = 1_700_000_000_000
NAMES = ("Anna", "Bert", "Carla", "Dario", "Elif", "Femi", "Goran", "Hana")
FILES = {name: {"bytes": 1_000_000, "sha256": "0" * 64} for name in ("head.ply", "head.glb", "bust.ply", "report.json")}


def identity(number: int, kind: int) -> str:
    return f"{EPOCH_MS + 1000 * number:012x}{kind:04x}{number:012x}"


def fill_records(store: Store, captures: int) -> Iterator[str]:
    """Writes captures and their sessions; yields the captures' ids."""
    cameras = tuple(CameraSize(f"cam{i:02}", 4096, 3000) for i in range(11))
    inputs = {f"images/cam{i:02}.png": "0" * 64 for i in range(11)}
    created = "2026-01-01T00:00:00.000Z"
    for number in range(captures):
        session = identity(number // CAPTURES_A_SESSION, 1)
        if number % CAPTURES_A_SESSION == 0:
            label = f"{NAMES[number // CAPTURES_A_SESSION % len(NAMES)]} {number // CAPTURES_A_SESSION // 2}"
            record = SessionRecord(session, created, label, "signed")
            (store.data / "sessions" / f"{session}.json").write_text(json.dumps(SESSION.document(record)))
        verdict = ("good", "good", "usable", "poor", None)[number % 5]
        record = CaptureRecord(
            identity(number, 2), created, "rig", session, f"take {number}", "neutral", cameras, "cam00", inputs, 10**8,
            features=False, verdict=verdict,
        )  # fmt: skip
        folder = store.data / "captures" / record.id
        folder.mkdir()
        (folder / "record.json").write_text(json.dumps(CAPTURE.document(record)))
        yield record.id


def fill_jobs(engine: sa.Engine, jobs: Jobs, captures: list[str], count: int) -> None:
    """Copies the engine's rows of one real job ``count`` times: most succeeded, some failed, some wait, two run."""
    template = jobs.submit(captures[0], ReconstructionRequest(settings={"detail": "fine"}))
    schema = None if engine.dialect.name == "sqlite" else "dbos"
    tables = sa.MetaData()
    tables.reflect(engine, schema=schema, only=["workflow_status", "workflow_input", "workflow_output"])
    status, input_table, made = (
        tables.tables[(f"{schema}." if schema else "") + n]
        for n in ("workflow_status", "workflow_input", "workflow_output")
    )
    output = base64.b64encode(pickle.dumps(FILES)).decode()
    with engine.connect() as connection:
        row = dict(connection.execute(sa.select(status).where(status.c.workflow_uuid == template.id)).mappings().one())
        inputs = dict(
            connection.execute(sa.select(input_table).where(input_table.c.workflow_uuid == template.id))
            .mappings()
            .one()
        )
    words = words_of_job({"capture_id": captures[0], "model": None, "settings": {"detail": "fine"}})
    for start in range(0, count, AT_ONCE):
        rows: list[list[dict[str, Any]]] = [[], [], [], []]
        for number in range(start, min(count, start + AT_ONCE)):
            job, capture, left = identity(number, 3), captures[number % len(captures)], count - number
            state = "ENQUEUED" if left <= QUEUED else "PENDING" if left <= QUEUED + RUNNING else "SUCCESS"
            state = "ERROR" if state == "SUCCESS" and number % 20 == 0 else state
            ended = EPOCH_MS + 1000 * number + 60_000 if state in ("SUCCESS", "ERROR") else None
            columns = {
                "workflow_uuid": job,
                "status": state,
                "created_at": EPOCH_MS + 1000 * number,
                "completed_at": ended,
            }
            rows[0].append({**row, **columns, "executor_id": "gone" if state == "PENDING" else None})
            rows[1].append({**inputs, "workflow_uuid": job})
            if state == "SUCCESS":
                blank = dict.fromkeys(column.name for column in made.c)
                rows[2].append({**blank, "workflow_uuid": job, "output": output, "retention_timestamp": EPOCH_MS})
            rows[3].append(
                {"job_id": job, "capture_id": capture, "session": None, "words": words.replace(template.id, job)}
            )
        with engine.begin() as connection:
            for table, values in zip((status, input_table, made, job_index), rows, strict=True):
                if values:
                    connection.execute(sa.insert(table), values)


def fill_batches(engine: sa.Engine, captures: list[str], jobs: int, count: int) -> None:
    """Shares the jobs out among batches, oldest first; the last ones, whose jobs wait, have not finished."""
    each = jobs // max(1, count)
    for number in range(count):
        made = range(number * each, (number + 1) * each)
        ended = jobs - made.stop >= QUEUED + RUNNING
        created = EPOCH_MS + 1000 * made.start
        row = {"id": identity(number, 4), "created": created, "label": f"Study {number}", "words": f"study {number}"}
        row |= {"key": "local", "digest": "", "wish": "running", "finished": created + 1 if ended else None}
        row |= {"rounds": int(ended), "queue": "cpu", "priority": 500, "model": None, "settings": "{}"}
        items = [
            {
                "batch_id": row["id"],
                "position": place,
                "capture_id": captures[job % len(captures)],
                "job_id": identity(job, 3),
                "recalled": False,
            }
            for place, job in enumerate(made)
        ]
        with engine.begin() as connection:
            connection.execute(sa.insert(batches).values(**row))
            connection.execute(sa.insert(batch_items), items)


def filled(settings: ServiceSettings, captures: int, jobs: int, batch_count: int) -> None:
    store, engine = Store(settings.data), open_database(settings)
    ids = [*fill_records(store, captures)]
    migrate(settings)
    library = Library(engine)
    library.reconcile(store)
    all_jobs = Jobs(settings, store, engine, library)
    fill_jobs(engine, all_jobs, ids, jobs)
    fill_batches(engine, ids, jobs, batch_count)
    with engine.begin() as connection:
        connection.execute(sa.text("ANALYZE"))  # as both databases do by themselves in time
    all_jobs.close()
    engine.dispose()


def lists(captures: int, batch_count: int) -> dict[str, str]:
    """Addresses by what they list; a page far behind begins before one of the middle."""
    middle, batch = identity(captures // 2, 2), identity(batch_count // 2, 4)
    return {
        "captures": "/v1/captures?limit=100",
        "captures, far behind": f"/v1/captures?limit=100&before={middle}",
        "captures by label": "/v1/captures?limit=100&sort=label",
        "captures by verdict": "/v1/captures?limit=100&sort=verdict",
        "captures, poor": "/v1/captures?limit=100&verdict=poor",
        "captures, word in a session": "/v1/captures?limit=100&q=carla",
        "captures, word of nobody": "/v1/captures?limit=100&q=zacharias",
        "a capture's jobs": f"/v1/jobs?capture={middle}",
        "jobs": "/v1/jobs?limit=100",
        "jobs, running": "/v1/jobs?limit=100&state=running",
        "jobs, queued": "/v1/jobs?limit=100&state=queued",
        "jobs, failed": "/v1/jobs?limit=100&state=failed",
        "jobs by end": "/v1/jobs?limit=100&sort=-finished",
        "jobs, word of a session": "/v1/jobs?limit=100&q=carla",
        "jobs, two words": "/v1/jobs?limit=100&q=fine+anna",
        "batches": "/v1/batches?limit=100",
        "batches, running": "/v1/batches?limit=100&state=running",
        "batches, word": "/v1/batches?limit=100&q=study",
        "a batch": f"/v1/batches/{batch}",
        "a batch's jobs": f"/v1/jobs?limit=100&batch={batch}",
        "a batch's failed jobs": f"/v1/jobs?limit=100&batch={batch}&state=failed",
        "sessions": "/v1/sessions?limit=100",
        "subjects": "/v1/subjects?limit=100",
        "subjects by name": "/v1/subjects?limit=100&sort=label",
        "subjects, word": "/v1/subjects?limit=100&q=hana",
        "info": "/v1/info",
        "metrics": "/metrics",
    }


def measured(url: str, captures: int, batch_count: int, rounds: int) -> dict[str, list[float]]:
    seconds = {}
    with httpx.Client(base_url=url, timeout=120) as client:
        for name, address in lists(captures, batch_count).items():
            took = []
            for _ in range(rounds):
                began = time.monotonic()
                answer = client.get(address)
                took.append(time.monotonic() - began)
                assert answer.status_code == 200, answer.text
            seconds[name] = [*np.percentile(took, (50, 95, 100)).round(3).tolist()]
    return seconds


def run(
    scratch: Path,
    *,
    captures: int = 100_000,
    jobs: int = 200_000,
    batches: int = 500,
    rounds: int = 5,
    postgres: bool = False,
    keep: Path | None = None,
) -> dict[str, Any]:
    """Returns the figures of this module."""
    with ExitStack() as stack:
        folder = keep or scratch
        extra: dict[str, Any] = {"database_url": stack.enter_context(running_postgres())} if postgres else {}
        settings = ServiceSettings(data=folder / "data", jobs_per_key=10**6, **extra)
        if not (folder / "data").is_dir():
            filled(settings, captures, jobs, batches)
        began = time.monotonic()
        with running_service(settings.data, worker=False, terminal=None, silent_s="100000", **extra) as service:
            started = round(time.monotonic() - began, 1)
            figures = measured(service.url, captures, batches, rounds)
    database = "postgresql" if postgres else "sqlite"
    counts = {"captures": captures, "jobs": jobs, "batches": batches}
    seconds = {"start_s": started, "list_s [median, 95th percentile, slowest]": figures}
    return {"figures": {"database": database, **counts, **seconds}}
