"""Declares the routes of jobs: submitting, watching, cancelling and restarting jobs, and fetching result files."""

from collections import Counter
from collections.abc import AsyncIterator, Callable
from functools import partial
from typing import Annotated
from urllib.parse import quote

import anyio
from fastapi import APIRouter, Depends, Header, Query, Request, Response
from fastapi.responses import FileResponse, PlainTextResponse, RedirectResponse, StreamingResponse
from fastapi.sse import EventSourceResponse, ServerSentEvent

from rig.errors import InputError
from rig.messages.message import compose
from server.http.auth import Reader, ServiceOf, Submitter
from server.http.schemas import (
    Cursor,
    Idempotency,
    JobBatch,
    JobBulk,
    JobList,
    Key,
    Limit,
    NewDelivery,
    NewExport,
    NewJob,
    NewSessionJobs,
    Restart,
    ResultList,
    Sought,
)
from server.services.answer import State
from server.services.bulk import BulkOut, apply_each
from server.services.job_rows import FINISHED, STATUSES
from server.services.records import JobOut
from server.services.work import ReconstructionRequest
from server.storage.job_index import JobOrder, JobQuery
from server.storage.records import JobWebhook
from server.wire.patience import await_hang_up
from server.wire.problems import Responses, documented, sent_file
from server.wire.send_file import media_type, send_archive, send_file, send_zip

router = APIRouter(prefix="/v1", tags=["jobs"])
LOOKS_MOST = 8  # of a key's event streams in each ``poll_s``, at two queries; where there are more, each waits longer
streams = Counter[str]()  # open ones, by key

EXPORT: Responses = {200: {"content": {"application/zip": {}}}, **documented(400, 404, 409, 413, 415, 507)}


@router.post("/jobs", status_code=202, responses=documented(400, 404, 409, 413, 415, 507))
def submit_job(
    service: ServiceOf, caller: Submitter, wanted: NewJob, response: Response, idempotency_key: Idempotency = None
) -> JobOut:
    """Queues a reconstruction. Repeating the request with the same Idempotency-Key returns the first job."""
    hook: JobWebhook | None = wanted.webhook and {"url": wanted.webhook.url, "secret": wanted.webhook.secret}
    job = service.jobs.submit(
        wanted.capture_id,
        ReconstructionRequest(wanted.model, wanted.settings, wanted.name, hook, wanted.deliver_to),
        key=caller.key,
        idempotency_key=idempotency_key,
        queue=wanted.queue,
        priority=wanted.priority,
    )
    return _accepted(job, response)


@router.post("/sessions/{session_id}/jobs", status_code=202, responses=documented(400, 404, 413, 415, 507))
def submit_session(service: ServiceOf, caller: Submitter, session_id: str, wanted: NewSessionJobs) -> JobBatch:
    """Queues a reconstruction of every capture of a session that shows a head."""
    work = ReconstructionRequest(wanted.model, wanted.settings)
    jobs = service.jobs.submit_session(session_id, work, key=caller.key, priority=wanted.priority)
    return JobBatch(jobs=jobs)


@router.get("/jobs", responses=documented(400))
def list_jobs(
    service: ServiceOf,
    caller: Reader,
    q: Sought = "",
    *,
    state: State | None = None,
    capture: Key = None,
    session: Key = None,
    batch: Key = None,
    sort: JobOrder = "-created",
    limit: Limit = 100,
    cursor: Cursor = None,
    offset: Annotated[str | None, Query(include_in_schema=False)] = None,
) -> JobList:
    """Lists jobs in pages, newest first by default; ``q`` searches name, model, method, level, id and the capture's
    words."""
    if offset is not None:  # of clients before 0.3.0, which would read the first page again and again
        raise InputError("offset", [compose("cursor-in-place-of-offset")])
    query = JobQuery(q, None if state is None else STATUSES[state], capture, session, batch, sort)
    found = service.jobs.page(query, limit, cursor)
    return JobList(jobs=list(found.items), next=found.next, total=found.total)


@router.post("/jobs/bulk", responses=documented(400, 413, 415, 507))
def change_jobs(service: ServiceOf, caller: Submitter, wanted: JobBulk) -> BulkOut:
    """Applies one action to many jobs. Jobs that cannot take the action are reported and do not stop the others."""
    actions: dict[str, Callable[[str], object]] = {
        "cancel": service.cancel,
        "restart": lambda job: service.jobs.restart(job, ReconstructionRequest(), key=caller.key),
        "remove": service.jobs.delete,
    }
    return apply_each(wanted.ids, actions[wanted.action])


@router.get("/jobs/{job_id}", responses=documented(404))
def get_job(service: ServiceOf, caller: Reader, job_id: str) -> JobOut:
    """Returns a job: its state, stage, progress, remaining seconds and, once the job has succeeded, its files."""
    return service.jobs.get(job_id)


def known_job(service: ServiceOf, caller: Reader, job_id: str) -> str:
    """Returns the id of a job. Raises NotFound before a stream begins, since the status is sent before a stream's first
    byte."""
    service.jobs.state(job_id)
    return job_id


@router.get("/jobs/{job_id}/events", response_class=EventSourceResponse, responses=documented(404))
async def job_events(
    service: ServiceOf,
    caller: Reader,
    job: Annotated[str, Depends(known_job)],
    last_event_id: Annotated[str | None, Header(alias="Last-Event-ID", max_length=40)] = None,
) -> AsyncIterator[ServerSentEvent]:
    """Streams ``progress`` events (state, stage, progress, eta_s), and at the end one ``end`` event with the whole job.

    ``Last-Event-ID`` resumes after that event."""
    seq = int(last_event_id) if last_event_id and last_event_id.isascii() and last_event_id.isdigit() else 0
    streams[caller.key] += 1
    try:
        while True:
            # The state is read before the events, so that no event of an ended job is missed.
            state = await service.threads.disk(service.jobs.state, job)
            for event in await service.threads.disk(service.jobs.events.since, job, min(seq, 2**31 - 1)):
                seq = event.seq
                yield ServerSentEvent(event="progress", id=str(seq), data=event.document)
            if state in FINISHED:
                ended = await service.threads.disk(service.jobs.get, job)
                yield ServerSentEvent(event="end", id=str(seq), data=ended)
                return
            await anyio.sleep(service.settings.poll_s * max(1.0, streams[caller.key] / LOOKS_MOST))
    finally:
        streams[caller.key] -= 1


@router.post("/jobs/{job_id}/cancel", responses=documented(404))
def cancel_job(service: ServiceOf, caller: Submitter, job_id: str) -> JobOut:
    """Cancels a job, in any stage; its worker stops within a second. Cancelling has no effect on a finished job."""
    return service.cancel(job_id)


@router.post("/jobs/{job_id}/restart", status_code=202, responses=documented(400, 404, 413, 415, 507))
def restart_job(
    service: ServiceOf, caller: Submitter, job_id: str, response: Response, wanted: Restart | None = None
) -> JobOut:
    """Queues a new job for the same capture, with another model or other settings if the request names them;
    ``restart_of`` names the old job."""
    work = ReconstructionRequest(wanted.model, wanted.settings) if wanted else ReconstructionRequest()
    return _accepted(service.jobs.restart(job_id, work, key=caller.key), response)


@router.post("/jobs/{job_id}/delivery", status_code=202, responses=documented(400, 403, 404, 409, 413, 415))
def deliver_job(service: ServiceOf, caller: Submitter, job_id: str, wanted: NewDelivery | None = None) -> JobOut:
    """Delivers the result of a job to an object store: for the first time, again after a failure, or to another store.
    Answers 409 while the result is being delivered."""
    return service.deliver(job_id, None if wanted is None else wanted.to)


@router.post("/jobs/{job_id}/exports", responses=EXPORT, response_class=Response)
async def export_job(service: ServiceOf, caller: Reader, request: Request, job_id: str, wanted: NewExport) -> Response:
    """Returns the head of a finished job in another format, with its materials and textures, as one .zip. The export
    makes no new job."""
    gone = partial(await_hang_up, request.receive)
    return send_zip(await service.threads.check(service.export, job_id, wanted.outputs(), key=caller.key, hung_up=gone))


@router.delete("/jobs/{job_id}", status_code=204, responses=documented(404, 409))
def delete_job(service: ServiceOf, caller: Submitter, job_id: str) -> None:
    """Removes a finished job with its result."""
    service.jobs.delete(job_id)


@router.get(
    "/jobs/{job_id}/log",
    responses={200: {"content": {"text/plain": {"schema": {"type": "string"}}}}, **documented(404)},
    response_class=PlainTextResponse,
)
def get_job_log(service: ServiceOf, caller: Reader, job_id: str) -> str:
    """Returns the workers' log of a job: stages, warnings, outcome. Answers 404 before the job begins."""
    return service.jobs.log(job_id)


ARCHIVE: Responses = {
    200: {"content": {"application/zip": {}}},
    304: {"description": "Not Modified"},
    **documented(404, 409),
}
RESULT: Responses = {
    **sent_file("application/octet-stream", "model/gltf-binary", "application/json", "image/png"),
    307: {"description": "Temporary Redirect"},
    **documented(404, 409, 416),
}


@router.get("/jobs/{job_id}/result", responses=documented(404, 409))
def list_result(service: ServiceOf, caller: Reader, job_id: str) -> ResultList:
    """Lists the files of a job's result. Each file is fetched at its ``url``, all files together as ``all.zip``."""
    files = [
        {"name": name, "url": f"/v1/jobs/{job_id}/result/{quote(name)}", "media_type": media_type(name), **file}
        for name, file in service.jobs.files(job_id).items()
    ]
    return ResultList.model_validate({"job_id": job_id, "files": files})


@router.head("/jobs/{job_id}/result/all.zip", include_in_schema=False)
@router.get("/jobs/{job_id}/result/all.zip", responses=ARCHIVE, response_class=StreamingResponse)
def get_archive(service: ServiceOf, caller: Reader, request: Request, job_id: str) -> Response:
    """Returns all files of a job's result as one archive, which is packed while it is sent."""
    files = service.jobs.files(job_id)
    return send_archive(request, service.jobs.result_folder(job_id), files)


@router.head("/jobs/{job_id}/result/{name:path}", include_in_schema=False)
@router.get("/jobs/{job_id}/result/{name:path}", responses=RESULT, response_class=FileResponse)
def get_result(
    service: ServiceOf, caller: Reader, request: Request, job_id: str, name: str, redirect: bool = False
) -> Response:
    """Returns a file of a job's result: head.ply, head.glb, report.json, contact_sheet.png, overlays/<camera>.png and
    so on. ``GET .../result`` lists them. With ``redirect`` a result that an S3 store keeps is answered with 307 and a
    signed address of the store, which holds for five minutes and takes no API key."""
    address = service.jobs.results.link(job_id, name) if redirect and name in service.jobs.files(job_id) else None
    if address is not None:
        return RedirectResponse(address, 307, {"Cache-Control": "no-store"})
    return send_file(request, service.jobs.result_file(job_id, name))


def _accepted(job: JobOut, response: Response) -> JobOut:
    response.headers["Location"] = f"/v1/jobs/{job.id}"
    return job
