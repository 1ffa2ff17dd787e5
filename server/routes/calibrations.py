"""Calibrations: from an archive of board pictures or from shots that the rig took; looked at, fetched, removed."""

import hashlib
import json
from typing import Annotated, Any

from fastapi import APIRouter, Depends, Request, Response
from fastapi.exceptions import RequestValidationError
from fastapi.responses import FileResponse
from pydantic import ValidationError

from server.access import Caller, require
from server.files import send_file
from server.problems import Problem, documented
from server.schemas import CalibrationList, CalibrationOut, NewCalibration
from server.service import Service, ServiceOf
from server.uploads import check_length, described_form, receive_multipart

router = APIRouter(prefix="/v1/calibrations", tags=["calibrations"])
Reader = Annotated[Caller, Depends(require("read"))]
Taker = Annotated[Caller, Depends(require("capture"))]
JSON_BYTES = 1 << 20

BODY = described_form("archive of IMAGES/ and board.toml", ("label",))
BODY["requestBody"]["content"]["application/json"] = {"schema": NewCalibration.model_json_schema()}


@router.post("", status_code=202, responses=documented(400, 404, 413, 415, 507), openapi_extra=BODY)
async def make_calibration(service: ServiceOf, caller: Taker, request: Request, response: Response) -> CalibrationOut:
    """Queues a calibration of an uploaded archive (multipart), or of captures that the rig took of the board (JSON)."""
    await service.threads.disk(check_length, request, service.store, service.settings)
    if request.headers.get("content-type", "").partition(";")[0].strip() == "application/json":
        wanted = _parsed(await _small_body(request))
        made = await service.threads.check(_from_captures, service, wanted)
    else:
        with service.store.incoming() as folder:
            archive, fields = await receive_multipart(request, folder, service.settings, service.threads)
            label = (fields.get("label") or "")[:500]
            made = await service.threads.check(service.accept_board_pictures, archive, folder, label)
    response.headers["Location"] = f"/v1/calibrations/{made['id']}"
    return CalibrationOut.model_validate(made)


@router.get("", responses=documented())
def list_calibrations(service: ServiceOf, caller: Reader) -> CalibrationList:
    """Newest first."""
    return CalibrationList.model_validate({"calibrations": service.calibrations.find()})


@router.get("/{calibration_id}", responses=documented(404))
def get_calibration(service: ServiceOf, caller: Reader, calibration_id: str) -> CalibrationOut:
    return CalibrationOut.model_validate(service.calibrations.get(calibration_id))


FILE: dict[int | str, dict[str, Any]] = {
    200: {"content": {"application/json": {}}},
    206: {"description": "Partial Content"},
    304: {"description": "Not Modified"},
    **documented(404, 409, 416),
}


@router.get("/{calibration_id}/cameras.json", responses=FILE, response_class=FileResponse)
def get_cameras(service: ServiceOf, caller: Reader, request: Request, calibration_id: str) -> Response:
    path = service.calibrations.cameras_json(calibration_id)
    return send_file(request, path, hashlib.sha256(path.read_bytes()).hexdigest())


@router.get(
    "/{calibration_id}/report.html",
    responses=FILE | {200: {"content": {"text/html": {}}}},
    response_class=FileResponse,
)
def get_report(service: ServiceOf, caller: Reader, request: Request, calibration_id: str) -> Response:
    """One self-contained page: residuals, coverage, uncertainty."""
    path = service.calibrations.result(calibration_id, "report.html")
    return send_file(request, path, hashlib.sha256(path.read_bytes()).hexdigest())


@router.delete("/{calibration_id}", status_code=204, responses=documented(404, 409))
def remove_calibration(service: ServiceOf, caller: Taker, calibration_id: str) -> None:
    """A calibration in use stays in use: what is removed are its pictures and its report."""
    service.calibrations.remove(calibration_id)


def _from_captures(service: Service, wanted: NewCalibration) -> dict[str, Any]:
    from server.calibrations import from_captures

    with service.store.incoming() as folder:
        target = folder / "calibration"
        target.mkdir()
        from_captures(service.store, target, wanted.board, wanted.captures)
        return service.calibrations.add(target, "rig", wanted.label)


async def _small_body(request: Request) -> bytes:
    body = bytearray()
    async for chunk in request.stream():
        body += chunk
        if len(body) > JSON_BYTES:
            raise Problem(413, "body-too-large", f"A JSON body may have {JSON_BYTES:,} bytes.")
    return bytes(body)


def _parsed(body: bytes) -> NewCalibration:
    try:
        return NewCalibration.model_validate(json.loads(body))
    except ValidationError as error:
        raise RequestValidationError(error.errors()) from error
    except (ValueError, RecursionError) as error:
        raise Problem(422, "invalid-request", "The body is no JSON.", [str(error)[:200]]) from error
