"""Captures: taken with the rig or uploaded, looked at, given feature points, removed."""

import json
from pathlib import Path
from typing import Annotated, Any

from fastapi import APIRouter, Depends, Query, Request, Response
from fastapi.responses import FileResponse

from rig.errors import InputError
from server.access import Caller, require
from server.files import send_file
from server.problems import Problem, documented
from server.rigs import SHOT_BYTES
from server.schemas import CaptureEdit, CaptureList, CaptureOut, JobOut, NewCapture, NewFeatures
from server.service import Service, ServiceOf
from server.uploads import check_length, described_form, receive_multipart

router = APIRouter(prefix="/v1", tags=["captures"])
Reader = Annotated[Caller, Depends(require("read"))]
Taker = Annotated[Caller, Depends(require("capture"))]

ARCHIVE = ".zip, .tar or .tar.gz"
FIELDS = ("session", "label", "expression")


@router.post("/captures", status_code=201, responses=documented(400, 404, 413, 415, 507))
def take_capture(service: ServiceOf, caller: Taker, wanted: NewCapture, response: Response) -> CaptureOut:
    """Triggers the rig now; answers once every camera delivered (201) or the fault is known (503).

    ``board``: pictures of the calibration board, from the cameras that deliver, for ``POST /v1/calibrations``."""
    service.store.reserve(SHOT_BYTES, service.settings.free_bytes)
    if wanted.session is not None:
        service.store.session(wanted.session)
    with service.store.incoming() as folder:
        capture = folder / "capture"
        shot = service.rig.capture(capture, seed=wanted.seed, board=wanted.board)
        with service.children.one() as child:
            arguments = {"folder": str(capture / "files"), "image_pixels": service.settings.image_pixels}
            content = child.run(f"server.ingest:ingest_{'board' if wanted.board else 'folder'}", arguments)
        record = service.add_capture(capture, "rig", content, wanted.model_dump(), shot)
    return _created(record, response)


@router.post(
    "/captures/uploads",
    status_code=201,
    responses=documented(400, 404, 413, 415, 507),
    openapi_extra=described_form(ARCHIVE, FIELDS),
)
async def upload_capture(service: ServiceOf, caller: Taker, request: Request, response: Response) -> CaptureOut:
    """Takes a capture folder as an archive; 422 names every fault in it, and then nothing of it is kept."""
    record, _ = await accept_upload(service, request)
    return _created(record, response)


async def accept_upload(service: Service, request: Request) -> tuple[dict[str, Any], dict[str, str]]:
    """Receives a multipart archive and makes a capture of it; returns its record and the form's fields."""
    await service.threads.disk(check_length, request, service.store, service.settings)
    with service.store.incoming() as folder:
        archive, fields = await receive_multipart(request, folder, service.settings, service.threads)
        about = {name: fields.get(name) or None for name in FIELDS}
        check_about(about)
        record = await service.threads.check(service.accept_archive, archive, folder, about)
    return record, fields


def refuse_board(record: dict[str, Any]) -> None:
    """Raises a 409 problem for pictures of the calibration board, which show no head."""
    if record.get("board"):
        raise Problem(409, "board-shot", "The capture is of the calibration board; it can only be calibrated from.")


def check_about(about: dict[str, Any]) -> None:
    faults = [f"{name}: longer than 500 characters" for name in FIELDS if len(about.get(name) or "") > 500]
    if faults:
        raise InputError("form", faults)


@router.get("/captures", responses=documented(400))
def list_captures(
    service: ServiceOf,
    caller: Reader,
    session: Annotated[str | None, Query(max_length=64)] = None,
    limit: Annotated[int, Query(ge=1, le=1000)] = 100,
    before: Annotated[str | None, Query(max_length=64, description="only captures older than this id")] = None,
) -> CaptureList:
    """Newest first."""
    found = []
    for record in service.store.captures():
        if (before is None or record["id"] < before) and (session is None or record["session"] == session):
            found.append(record)
        if len(found) == limit:
            break
    return CaptureList.model_validate({"captures": found})


@router.get("/captures/{capture_id}", responses=documented(404))
def get_capture(service: ServiceOf, caller: Reader, capture_id: str) -> CaptureOut:
    return CaptureOut.model_validate(service.store.capture(capture_id))


@router.patch("/captures/{capture_id}", responses=documented(400, 404, 413, 415, 507))
def edit_capture(service: ServiceOf, caller: Taker, capture_id: str, wanted: CaptureEdit) -> CaptureOut:
    """Another label, expression or session."""
    given = wanted.model_dump(exclude_unset=True)
    if given.get("session") is not None:
        service.store.session(given["session"])
    given |= {name: given[name] or "" for name in ("label", "expression") if name in given}
    return CaptureOut.model_validate(service.store.change_capture(capture_id, lambda record: record.update(given)))


IMAGE_RESPONSES: dict[int | str, dict[str, Any]] = {
    200: {"content": {f"image/{kind}": {} for kind in ("png", "jpeg", "tiff", "webp")}},
    206: {
        "description": "Partial Content",
        "content": {f"image/{kind}": {} for kind in ("png", "jpeg", "tiff", "webp")},
    },
    304: {"description": "Not Modified"},
    **documented(404, 416),
}


@router.get("/captures/{capture_id}/images/{camera}", responses=IMAGE_RESPONSES, response_class=FileResponse)
def get_image(service: ServiceOf, caller: Reader, request: Request, capture_id: str, camera: str) -> Response:
    return _image(service, request, capture_id, "images", camera)


@router.get("/captures/{capture_id}/backgrounds/{camera}", responses=IMAGE_RESPONSES, response_class=FileResponse)
def get_background(service: ServiceOf, caller: Reader, request: Request, capture_id: str, camera: str) -> Response:
    """The first clean plate of a camera."""
    return _image(service, request, capture_id, "background", camera)


@router.put("/captures/{capture_id}/features", responses=documented(400, 404, 409, 413, 415, 507))
def put_features(service: ServiceOf, caller: Taker, capture_id: str, features: NewFeatures) -> CaptureOut:
    """Stores feature points; 422 names every point that the capture cannot have. Jobs made from now on use them."""
    refuse_board(service.store.capture(capture_id))
    arguments = {
        "folder": str(service.store.folder("captures", capture_id) / "files"),
        "document": features.model_dump(),
    }
    with service.children.one() as child:
        digest = child.run("server.ingest:check_features", arguments)

    def change(record: dict[str, Any]) -> None:
        record["inputs"] = dict(sorted({**record["inputs"], "features.json": digest}.items()))
        record["features"] = True

    return CaptureOut.model_validate(service.store.change_capture(capture_id, change))


@router.get("/captures/{capture_id}/features", responses=documented(404))
def get_features(service: ServiceOf, caller: Reader, capture_id: str) -> NewFeatures:
    record = service.store.capture(capture_id)
    if not record["features"]:
        return NewFeatures(points={})
    path = service.store.folder("captures", capture_id) / "files" / "features.json"
    return NewFeatures.model_validate(json.loads(path.read_text()))


@router.delete("/captures/{capture_id}", status_code=204, responses=documented(404, 409))
def delete_capture(service: ServiceOf, caller: Taker, capture_id: str) -> None:
    """Removes a capture with its images; its jobs and their results stay. 409 while a job needs it."""
    service.store.capture(capture_id)
    active = service.jobs.active(capture=capture_id)
    if active:
        detail = "Jobs that are queued or running need this capture; cancel them first."
        raise Problem(409, "capture-in-use", detail, [f"job {job}" for job in active])
    service.store.remove_capture(capture_id)


@router.post(
    "/reconstructions",
    status_code=202,
    tags=["jobs"],
    responses=documented(400, 404, 409, 413, 415, 507),
    openapi_extra=described_form(ARCHIVE, (*FIELDS, "model"), settings="JSON object"),
)
async def reconstruct_upload(
    service: ServiceOf,
    caller: Annotated[Caller, Depends(require("submit"))],
    request: Request,
    response: Response,
) -> JobOut:
    """Upload and job in one call."""
    from server.routes.jobs import checked_request, submit

    record, fields = await accept_upload(service, request)
    try:
        wanted = checked_request(record["id"], fields.get("model") or None, _settings_of(fields.get("settings")))
        job = await service.threads.disk(
            submit, service, caller, record, wanted, request.headers.get("idempotency-key")
        )
    except BaseException:
        service.store.remove_capture(record["id"])
        raise
    if job["capture_id"] != record["id"]:  # the key's first call made the job; this upload is not needed
        service.store.remove_capture(record["id"])
    response.headers["Location"] = f"/v1/jobs/{job['id']}"
    return JobOut.model_validate(job)


def _settings_of(text: str | None) -> dict[str, Any] | None:
    if not text:
        return None
    try:
        document = json.loads(text)
    except (ValueError, RecursionError) as error:
        raise InputError("settings", [f"is no JSON ({error})"]) from error
    if not isinstance(document, dict):
        raise InputError("settings", ["is no JSON object"])
    return document


def _created(record: dict[str, Any], response: Response) -> CaptureOut:
    response.headers["Location"] = f"/v1/captures/{record['id']}"
    return CaptureOut.model_validate(record)


def _image(service: Service, request: Request, capture_id: str, kind: str, camera: str) -> Response:
    """A file of the capture is found in its record, never by putting the request's text into a path."""
    record = service.store.capture(capture_id)
    for name, digest in record["inputs"].items():
        path = Path(name)
        single = path.parent.name == kind and path.stem == camera
        if single or (kind == "background" and path.parent.name == camera and path.parent.parent.name == kind):
            return send_file(request, service.store.folder("captures", capture_id) / "files" / name, digest)
    raise Problem(404, "not-found", f"The capture has no such file of a camera {camera!r:.80}.")
