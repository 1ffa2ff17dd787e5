"""Jobs: submitted, watched, cancelled, restarted; and the files that they made."""

from collections.abc import AsyncIterator
from typing import Annotated, Any

from fastapi import APIRouter, Depends, Header, Query, Request, Response
from fastapi.responses import FileResponse
from fastapi.sse import EventSourceResponse, ServerSentEvent

from pipeline.settings import settings_from_document
from rig.errors import InputError
from server.access import Caller, require
from server.files import send_file
from server.jobs import FINISHED
from server.problems import Problem, documented, not_found
from server.routes.captures import refuse_board
from server.schemas import JobList, JobOut, NewJob, NewSessionJobs, Restart, State
from server.service import Service, ServiceOf

router = APIRouter(prefix="/v1", tags=["jobs"])
Reader = Annotated[Caller, Depends(require("read"))]
Submitter = Annotated[Caller, Depends(require("submit"))]
Idempotency = Annotated[str | None, Header(alias="Idempotency-Key", min_length=1, max_length=200)]


def checked_request(capture_id: str, model: str | None, settings: dict[str, Any] | None) -> dict[str, Any]:
    """What a job stores. Raises InputError."""
    checked_work(model, settings)
    return {"capture_id": capture_id, "model": model, "settings": settings or {}}


def checked_work(model: str | None, settings: dict[str, Any] | None) -> None:
    """Raises InputError for an unknown model or setting, so that a job does not fail hours later."""
    from pipeline.eigenheads.model import list_models

    if model is not None and model != "default" and model not in list_models():
        known = ", ".join(["default", *list_models()])
        raise InputError("model", [f"{model!r:.80} is not at hand; there are: {known}"])
    settings_from_document(settings or {})


def submit(
    service: Service,
    caller: Caller,
    capture: dict[str, Any],
    request: dict[str, Any],
    idempotency_key: str | None,
    queue: str | None = None,
    priority: int = 100,
) -> dict[str, Any]:
    refuse_board(capture)
    if queue is not None and queue not in service.settings.queues:
        raise InputError("queue", [f"{queue!r:.40} is no queue; there are: {', '.join(service.settings.queues)}"])
    service.store.reserve(0, service.settings.free_bytes)
    return service.jobs.submit(
        request,
        session=capture["session"],
        key=caller.key,
        idempotency_key=idempotency_key,
        queue=queue,
        priority=priority,
    )


@router.post("/jobs", status_code=202, responses=documented(400, 404, 409, 413, 415, 507))
def submit_job(
    service: ServiceOf, caller: Submitter, wanted: NewJob, response: Response, idempotency_key: Idempotency = None
) -> JobOut:
    """Queues a reconstruction. The same Idempotency-Key with the same request returns the first job."""
    request = checked_request(wanted.capture_id, wanted.model, wanted.settings)
    capture = service.store.capture(wanted.capture_id)
    job = submit(service, caller, capture, request, idempotency_key, wanted.queue, wanted.priority)
    return _accepted(job, response)


@router.post("/sessions/{session_id}/jobs", status_code=202, responses=documented(400, 404, 413, 415, 507))
def submit_session(service: ServiceOf, caller: Submitter, session_id: str, wanted: NewSessionJobs) -> JobList:
    """Queues a reconstruction of every capture of a session."""
    service.store.session(session_id)
    jobs = []
    for capture in service.store.captures():
        if capture["session"] == session_id and not capture.get("board"):
            request = checked_request(capture["id"], wanted.model, wanted.settings)
            jobs.append(submit(service, caller, capture, request, None, None, wanted.priority))
    return JobList.model_validate({"jobs": jobs})


@router.get("/jobs", responses=documented(400))
def list_jobs(
    service: ServiceOf,
    caller: Reader,
    state: State | None = None,
    capture: Annotated[str | None, Query(max_length=64)] = None,
    session: Annotated[str | None, Query(max_length=64)] = None,
    limit: Annotated[int, Query(ge=1, le=1000)] = 100,
    offset: Annotated[int, Query(ge=0, le=1_000_000)] = 0,
) -> JobList:
    """Newest first."""
    jobs = service.jobs.find(state=state, capture=capture, session=session, limit=limit, offset=offset)
    return JobList.model_validate({"jobs": jobs})


@router.get("/jobs/{job_id}", responses=documented(404))
def get_job(service: ServiceOf, caller: Reader, job_id: str) -> JobOut:
    return JobOut.model_validate(service.jobs.get(job_id))


def known_job(service: ServiceOf, caller: Reader, job_id: str) -> str:
    """A stream's 404 must come before its first byte."""
    service.jobs.state(job_id)
    return job_id


@router.get("/jobs/{job_id}/events", response_class=EventSourceResponse, responses=documented(404))
async def job_events(
    service: ServiceOf,
    job: Annotated[str, Depends(known_job)],
    last_event_id: Annotated[str | None, Header(alias="Last-Event-ID", max_length=40)] = None,
) -> AsyncIterator[ServerSentEvent]:
    """``progress`` events (state, stage, progress, eta_s) and at the end one ``end`` event with the whole job.

    ``Last-Event-ID`` resumes after that event.
    """
    import anyio

    seq = int(last_event_id) if last_event_id and last_event_id.isascii() and last_event_id.isdigit() else 0
    while True:
        state = await service.threads.disk(service.jobs.state, job)  # asked first: the last events are already there
        for event in await service.threads.disk(service.jobs.events.since, job, min(seq, 2**31 - 1)):
            seq = event.seq
            yield ServerSentEvent(event="progress", id=str(seq), data=event.document)
        if state in FINISHED:
            yield ServerSentEvent(event="end", id=str(seq), data=await service.threads.disk(service.jobs.get, job))
            return
        await anyio.sleep(service.settings.poll_s)


@router.post("/jobs/{job_id}/cancel", responses=documented(404))
def cancel_job(service: ServiceOf, caller: Submitter, job_id: str) -> JobOut:
    """Takes effect within a second in any stage; a finished job stays as it is."""
    before = service.jobs.state(job_id)
    job = service.jobs.cancel(job_id)
    if before not in FINISHED and job["state"] == "cancelled":
        service.webhooks.announce(job_id, "cancelled", service.jobs.client.enqueue)
    return JobOut.model_validate(job)


@router.post("/jobs/{job_id}/restart", status_code=202, responses=documented(400, 404, 413, 415, 507))
def restart_job(
    service: ServiceOf, caller: Submitter, job_id: str, response: Response, wanted: Restart | None = None
) -> JobOut:
    """A new job for the same capture, perhaps with another model or settings; ``restart_of`` names the old one."""
    settings = wanted.settings if wanted else None
    model = wanted.model if wanted else None
    checked_work(model, settings)
    return _accepted(service.jobs.restart(job_id, settings, model=model, key=caller.key), response)


@router.delete("/jobs/{job_id}", status_code=204, responses=documented(404, 409))
def delete_job(service: ServiceOf, caller: Submitter, job_id: str) -> None:
    """Removes a finished job with its result."""
    service.jobs.delete(job_id)


RESULT = {
    200: {
        "content": {"application/octet-stream": {}, "model/gltf-binary": {}, "application/json": {}, "image/png": {}}
    },
    206: {"description": "Partial Content"},
    304: {"description": "Not Modified"},
    **documented(404, 409, 416),
}


@router.get("/jobs/{job_id}/result/{name}", responses=RESULT, response_class=FileResponse)
def get_result(service: ServiceOf, caller: Reader, request: Request, job_id: str, name: str) -> Response:
    """head.ply, head.glb, report.json, contact_sheet.png; the job's ``files`` lists what there is."""
    return _result(service, request, job_id, name)


@router.get("/jobs/{job_id}/result/overlays/{name}", responses=RESULT, response_class=FileResponse)
def get_overlay(service: ServiceOf, caller: Reader, request: Request, job_id: str, name: str) -> Response:
    """``<camera>.png``"""
    return _result(service, request, job_id, f"overlays/{name}")


def _result(service: Service, request: Request, job_id: str, name: str) -> Response:
    job = service.jobs.get(job_id)
    if job["state"] != "succeeded":
        raise Problem(409, "no-result", f"The job is {job['state']}; it has no result.")
    file = job["files"].get(name)
    if file is None:
        raise not_found("file", name)
    return send_file(request, service.store.folder("jobs", job_id) / "result" / name, file["sha256"])


def _accepted(job: dict[str, Any], response: Response) -> JobOut:
    response.headers["Location"] = f"/v1/jobs/{job['id']}"
    return JobOut.model_validate(job)
