"""Sessions: one subject's captures, and their erasure."""

import time
from datetime import UTC, datetime
from typing import Annotated, Any

from fastapi import APIRouter, Depends, Response

from server.access import Caller, require
from server.jobs import FINISHED
from server.problems import Problem, documented
from server.schemas import NewSession, SessionEdit, SessionList, SessionOut
from server.service import Service, ServiceOf
from server.store import new_id

router = APIRouter(prefix="/v1", tags=["sessions"])
Reader = Annotated[Caller, Depends(require("read"))]
Taker = Annotated[Caller, Depends(require("capture"))]

CANCEL_S = 5.0  # a cancelled job lets go of its files within one second


@router.post("/sessions", status_code=201, responses=documented(400, 413, 415, 507))
def make_session(service: ServiceOf, caller: Taker, wanted: NewSession, response: Response) -> SessionOut:
    created = datetime.now(UTC).isoformat(timespec="milliseconds").replace("+00:00", "Z")
    record = {"id": new_id(), "created": created, **wanted.model_dump()}
    service.store.save_session(record)
    response.headers["Location"] = f"/v1/sessions/{record['id']}"
    return SessionOut.model_validate({**record, "captures": []})


@router.get("/sessions", responses=documented())
def list_sessions(service: ServiceOf, caller: Reader) -> SessionList:
    """Newest first."""
    of: dict[str, list[str]] = {}
    for capture in service.store.captures():
        of.setdefault(capture["session"], []).append(capture["id"])
    sessions = [{**record, "captures": of.get(record["id"], [])} for record in service.store.sessions()]
    return SessionList.model_validate({"sessions": sessions})


@router.get("/sessions/{session_id}", responses=documented(404))
def get_session(service: ServiceOf, caller: Reader, session_id: str) -> SessionOut:
    record = service.store.session(session_id)
    return SessionOut.model_validate({**record, "captures": [c["id"] for c in _captures(service, session_id)]})


@router.patch("/sessions/{session_id}", responses=documented(400, 404, 413, 415, 507))
def edit_session(service: ServiceOf, caller: Taker, session_id: str, wanted: SessionEdit) -> SessionOut:
    """Another label or consent note."""
    given = {name: text for name, text in wanted.model_dump(exclude_unset=True).items() if text is not None}
    service.store.save_session(service.store.session(session_id) | given)
    return get_session(service, caller, session_id)


@router.delete("/sessions/{session_id}", status_code=204, responses=documented(404))
def erase_session(service: ServiceOf, caller: Taker, session_id: str) -> None:
    """Erases a subject: cancels the jobs, then removes images, results, caches and what the job database holds of
    them."""
    service.store.session(session_id)
    erase(service, session_id)


def erase(service: Service, session_id: str) -> None:
    """The session's own record goes last, so that an erasure that was cut short can be asked for again."""
    captures = _captures(service, session_id)
    jobs = {job["id"] for job in service.jobs.find(session=session_id, limit=100_000)}
    for capture in captures:
        jobs |= {job["id"] for job in service.jobs.find(capture=capture["id"], limit=100_000)}
    active = [job for job in jobs if service.jobs.state(job) not in FINISHED]
    for job in jobs:
        service.jobs.cancel(job)
    _await_workers(service, active)
    for job in jobs:
        _delete_job(service, job)
    for capture in captures:
        service.store.remove_capture(capture["id"])
    service.store.remove(service.store.folder("sessions", session_id).with_suffix(".json"))


def _await_workers(service: Service, jobs: list[str]) -> None:
    """Until no worker writes to the jobs any more, each of which then lacks its attempt's folder: it would put back
    what is erased here. One that was killed will not write either, but leaves its folder."""
    deadline = time.monotonic() + CANCEL_S
    folders = [service.store.folder("jobs", job) for job in jobs]
    while any([*folder.glob("attempt-*")] for folder in folders) and time.monotonic() < deadline:
        time.sleep(0.05)


def _delete_job(service: Service, job_id: str) -> None:
    service.jobs.delete(job_id)
    if service.store.folder("jobs", job_id).exists():
        raise Problem(503, "still-writing", "A worker still writes; ask for the erasure again.")


def _captures(service: Service, session_id: str) -> list[dict[str, Any]]:
    return [record for record in service.store.captures() if record["session"] == session_id]
