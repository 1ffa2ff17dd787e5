"""Declares the routes of captures: taking, uploading, viewing and removing captures, and setting feature points."""

from collections.abc import Callable
from functools import partial
from typing import Annotated, Literal

from fastapi import APIRouter, Query, Request, Response
from fastapi.responses import FileResponse

from rig.messages.message import compose
from server.errors import Forbidden
from server.http.auth import Reader, ServiceOf, Submitter, Taker
from server.http.schemas import (
    CaptureBulk,
    CaptureChecks,
    CaptureEdit,
    CaptureList,
    CaptureOut,
    Cursor,
    Idempotency,
    Key,
    Limit,
    NewCapture,
    NewFeatures,
    NewImport,
    Sought,
    WithTag,
)
from server.services.bulk import BulkOut, apply_each
from server.services.captures import CaptureMetadata
from server.services.erasure import HoldingsOut
from server.services.records import JobOut
from server.services.texts import PLAIN, TEXT_MOST, checked_tags
from server.services.work import ReconstructionRequest
from server.storage.library import CaptureOrder, CaptureQuery
from server.storage.records import CaptureRecord
from server.tasks.settings_file import settings_of_text
from server.wire.fetch import fetch_archive, fetch_stored_capture
from server.wire.multipart import ABOUT, ARCHIVE, described_form, receive_capture
from server.wire.problems import Responses, documented, sent_file
from server.wire.send_file import send_file

router = APIRouter(prefix="/v1", tags=["captures"])

FIELDS = ("session", "label", "expression")
OF_JOB = ("model", "name", "settings", "deliver_to")
TAGS = "with commas between"


@router.post("/captures", status_code=201, responses=documented(400, 404, 413, 415, 507))
def take_capture(service: ServiceOf, caller: Taker, wanted: NewCapture, response: Response) -> CaptureOut:
    """Takes a shot with the rig at once. Answers 201 if every camera has delivered a picture, and otherwise 503 with
    the missing cameras.

    ``board``: takes pictures of the calibration board for ``POST /v1/calibrations``, from those cameras that deliver.
    """
    about = CaptureMetadata(wanted.session, wanted.label, wanted.expression, checked_tags(wanted.tags))
    return _created(service.captures.take(about, seed=wanted.seed, board=wanted.board), response)


@router.post(
    "/captures/uploads",
    status_code=201,
    responses=documented(400, 404, 408, 413, 415, 507),
    openapi_extra=described_form(ARCHIVE, FIELDS, tags=TAGS),
)
async def upload_capture(service: ServiceOf, caller: Taker, request: Request, response: Response) -> CaptureOut:
    """Receives a capture folder as an archive. A capture with faults is not stored, and the answer 422 names them."""
    record, _ = await receive_capture(service, request, caller.key)
    return _created(record, response)


@router.post("/captures/imports", status_code=201, responses=documented(400, 404, 413, 415, 507))
async def import_capture(service: ServiceOf, caller: Taker, wanted: NewImport, response: Response) -> CaptureOut:
    """Downloads a capture folder as an archive from a server that the operator allowed (``EIGENHEAD_IMPORT_ORIGINS``;
    403 if none is), or takes it from an object store (``EIGENHEAD_IMPORT_PREFIXES``): an archive, or all files below a
    ``url`` that ends in a slash. Answers 422 naming every fault of the capture."""
    stored = wanted.url.startswith(("s3://", "file://"))
    if not (service.settings.import_prefixes if stored else service.settings.import_origins):
        raise Forbidden("imports-off", compose("stored-imports-not-allowed" if stored else "imports-not-allowed"))
    about = CaptureMetadata(wanted.session, wanted.label, wanted.expression, checked_tags(wanted.tags))
    with service.store.incoming() as folder:
        if stored:
            fetch = partial(fetch_stored_capture, wanted.url, folder, service.store, service.settings)
            archive = await service.threads.disk(fetch)
        else:
            archive = await fetch_archive(service, wanted.url, folder)
        record = await service.threads.check(service.captures.accept, archive, folder, about, key=caller.key)
    return _created(record, response)


@router.get("/captures", responses=documented(400))
def list_captures(
    service: ServiceOf,
    caller: Reader,
    q: Sought = "",
    *,
    session: Key = None,
    verdict: Annotated[Literal["good", "usable", "poor", "none"] | None, Query(description="none: not judged")] = None,
    tag: WithTag = None,
    sort: CaptureOrder = "-created",
    limit: Limit = 100,
    cursor: Cursor = None,
    before: Annotated[
        str | None, Query(max_length=64, pattern=PLAIN, description="only captures older than this id")
    ] = None,
) -> CaptureList:
    """Lists captures in pages, newest first by default; ``q`` searches label, expression, tags, session, verdict,
    source and id."""
    query = CaptureQuery(q, session, verdict, before=before, tag=tag, order=sort)
    found = service.captures.page(query, limit, cursor)
    captures = [CaptureOut.model_validate(record) for record in found.items]
    return CaptureList(captures=captures, next=found.next, total=found.total)


@router.post("/captures/bulk", responses=documented(400, 413, 415, 507))
def change_captures(service: ServiceOf, caller: Taker, wanted: CaptureBulk) -> BulkOut:
    """Applies one action to many captures. Captures to which the action cannot be applied are reported and do not stop
    the others. The action ``reconstruct`` also needs the scope ``submit``, and ``erase`` the scope ``erase``."""
    caller.check_may({"reconstruct": "submit", "erase": "erase"}.get(wanted.action, "capture"))
    work = ReconstructionRequest(wanted.model, wanted.settings)
    work.check()
    actions: dict[str, Callable[[str], object]] = {
        "remove": service.captures.remove,
        "erase": service.captures.erase,
        "reconstruct": lambda capture: service.jobs.submit(capture, work, key=caller.key),
        "move": lambda capture: service.captures.edit(capture, {"session": wanted.session}),
        "tag": lambda capture: service.captures.tag(capture, wanted.tags),
        "untag": lambda capture: service.captures.untag(capture, wanted.tags),
    }
    return apply_each(wanted.ids, actions[wanted.action])


@router.get("/captures/{capture_id}", responses=documented(404))
def get_capture(service: ServiceOf, caller: Reader, capture_id: str) -> CaptureOut:
    """Returns a capture: its cameras, its files with their sha256, and the rig's certificate of the shot."""
    return CaptureOut.model_validate(service.store.capture(capture_id))


@router.get("/captures/{capture_id}/checks", responses=documented(404))
def get_checks(service: ServiceOf, caller: Reader, capture_id: str) -> CaptureChecks:
    """Returns the reasons for a capture's verdict: by camera, exposure, sharpness, and the subject's outline."""
    return CaptureChecks.model_validate({"cameras": service.store.checks(capture_id)})


@router.patch("/captures/{capture_id}", responses=documented(400, 404, 413, 415, 507))
def edit_capture(service: ServiceOf, caller: Taker, capture_id: str, wanted: CaptureEdit) -> CaptureOut:
    """Changes label, expression, session or tags of a capture."""
    changes = wanted.model_dump(exclude_unset=True)
    changed = service.captures.edit(capture_id, changes, tags=changes.pop("tags", None))
    return CaptureOut.model_validate(changed)


IMAGES = ("image/png", "image/jpeg", "image/tiff", "image/webp")
IMAGE_RESPONSES: Responses = {**sent_file(*IMAGES), **documented(404, 416)}


@router.head("/captures/{capture_id}/images/{camera}", include_in_schema=False)
@router.get("/captures/{capture_id}/images/{camera}", responses=IMAGE_RESPONSES, response_class=FileResponse)
def get_image(service: ServiceOf, caller: Reader, request: Request, capture_id: str, camera: str) -> Response:
    """Returns a camera's photograph as it was received."""
    return send_file(request, service.captures.image(capture_id, "images", camera))


@router.head("/captures/{capture_id}/backgrounds/{camera}", include_in_schema=False)
@router.get("/captures/{capture_id}/backgrounds/{camera}", responses=IMAGE_RESPONSES, response_class=FileResponse)
def get_background(service: ServiceOf, caller: Reader, request: Request, capture_id: str, camera: str) -> Response:
    """Returns a clean plate of a camera, the first one if there are several."""
    return send_file(request, service.captures.image(capture_id, "background", camera))


@router.put("/captures/{capture_id}/features", responses=documented(400, 404, 409, 413, 415, 507))
def put_features(service: ServiceOf, caller: Taker, capture_id: str, features: NewFeatures) -> CaptureOut:
    """Stores feature points (pixels) for later jobs, in place of earlier points. Answers 422 naming every point that
    does not fit the capture, and 409 for a capture of the calibration board."""
    return CaptureOut.model_validate(service.captures.put_features(capture_id, features.points))


@router.get("/captures/{capture_id}/features", responses=documented(404))
def get_features(service: ServiceOf, caller: Reader, capture_id: str) -> NewFeatures:
    """Returns the stored feature points, in pixels, by point and camera."""
    return NewFeatures(points=service.captures.features(capture_id))


@router.get("/captures/{capture_id}/holdings", responses=documented(404))
def get_holdings(service: ServiceOf, caller: Reader, capture_id: str) -> HoldingsOut:
    """Returns which data a removal of the capture would delete, and which would stay."""
    return service.captures.holdings(capture_id)


@router.delete("/captures/{capture_id}", status_code=204, responses=documented(404, 409))
def delete_capture(
    service: ServiceOf,
    caller: Taker,
    capture_id: str,
    erase: Annotated[bool, Query(description="its jobs and heads, too, for good")] = False,
) -> None:
    """Removes a capture with its images. The capture's jobs and their results, which show the face, stay. Answers 409
    while a queued or running job needs the capture.

    With ``erase``, which needs the scope ``erase``, the capture's jobs are cancelled and removed with their results.
    """
    if erase:
        caller.check_may("erase")
        service.captures.erase(capture_id)
    else:
        service.captures.remove(capture_id)


@router.post(
    "/reconstructions",
    status_code=202,
    tags=["jobs"],
    responses=documented(400, 404, 408, 409, 413, 415, 507),
    openapi_extra=described_form(ARCHIVE, (*FIELDS, "model", "name", "deliver_to"), tags=TAGS, settings="JSON object"),
)
async def reconstruct_upload(
    service: ServiceOf, caller: Submitter, request: Request, response: Response, idempotency_key: Idempotency = None
) -> JobOut:
    """Receives a capture and queues a job for it in one call. Repeating the request with the same Idempotency-Key,
    files and settings returns the first job."""
    record, fields = await receive_capture(service, request, caller.key, (*ABOUT, *OF_JOB))
    try:
        name = (fields.get("name") or "")[:TEXT_MOST]
        place = fields.get("deliver_to") or None
        settings = settings_of_text(fields["settings"]) if fields.get("settings") else None
        wanted = ReconstructionRequest(fields.get("model") or None, settings, name, deliver_to=place)
        submit = partial(service.jobs.submit, record.id, wanted, key=caller.key, idempotency_key=idempotency_key)
        job = await service.threads.disk(submit)
    except BaseException:
        service.store.remove_capture(record.id, later=True)
        raise
    if job.capture_id != record.id:  # an earlier call with this key made the job, so this upload is removed
        service.store.remove_capture(record.id, later=True)
    response.headers["Location"] = f"/v1/jobs/{job.id}"
    return job


def _created(record: CaptureRecord, response: Response) -> CaptureOut:
    response.headers["Location"] = f"/v1/captures/{record.id}"
    return CaptureOut.model_validate(record)
