"""Declares the routes of sessions, the captures of one subject, and of their erasure."""

from fastapi import APIRouter, Response

from server.http.auth import Eraser, Reader, ServiceOf, Taker
from server.http.schemas import Cursor, Limit, NewSession, SessionEdit, SessionList, Sought, SubjectList, WithTag
from server.services.records import SessionOut
from server.storage.library import SubjectOrder
from server.wire.problems import documented

router = APIRouter(prefix="/v1", tags=["sessions"])


@router.post("/sessions", status_code=201, responses=documented(400, 413, 415, 507))
def make_session(service: ServiceOf, caller: Taker, wanted: NewSession, response: Response) -> SessionOut:
    """Begins a session, which holds captures of one subject."""
    made = service.sessions.add(wanted.label, wanted.consent)
    response.headers["Location"] = f"/v1/sessions/{made.id}"
    return made


@router.get("/sessions", responses=documented(400))
def list_sessions(
    service: ServiceOf, caller: Reader, q: Sought = "", limit: Limit = 100, cursor: Cursor = None
) -> SessionList:
    """Lists sessions in pages, newest first; ``q`` searches label and consent."""
    found = service.sessions.page(q, limit, cursor)
    return SessionList(sessions=list(found.items), next=found.next, total=found.total)


@router.get("/subjects", responses=documented(400))
def list_subjects(
    service: ServiceOf,
    caller: Reader,
    q: Sought = "",
    *,
    tag: WithTag = None,
    sort: SubjectOrder = "-created",
    limit: Limit = 100,
    cursor: Cursor = None,
) -> SubjectList:
    """Lists people in pages, each with the newest head. Sessions with the same name belong to one person. ``q``
    searches label and consent."""
    found = service.sessions.subjects(q, sort, limit, cursor, tag=tag)
    return SubjectList(subjects=list(found.items), next=found.next, total=found.total)


@router.get("/sessions/{session_id}", responses=documented(404))
def get_session(service: ServiceOf, caller: Reader, session_id: str) -> SessionOut:
    """Returns a session with the ids of its captures."""
    return service.sessions.get(session_id)


@router.patch("/sessions/{session_id}", responses=documented(400, 404, 413, 415, 507))
def edit_session(service: ServiceOf, caller: Taker, session_id: str, wanted: SessionEdit) -> SessionOut:
    """Changes the label or the consent note of a session. Keys that the request leaves out keep their values."""
    return service.sessions.edit(session_id, label=wanted.label, consent=wanted.consent)


@router.delete("/sessions/{session_id}", status_code=204, responses=documented(404))
def erase_session(service: ServiceOf, caller: Eraser, session_id: str) -> None:
    """Erases a session permanently: cancels its jobs, then removes images, results, caches and its data in the job
    database."""
    service.sessions.erase(session_id)
