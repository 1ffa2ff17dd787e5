"""Declares the routes of calibrations, made from an archive of board pictures or from shots that the rig took."""

import json

from fastapi import APIRouter, Request, Response
from fastapi.exceptions import RequestValidationError
from fastapi.responses import FileResponse
from pydantic import ValidationError

from rig.messages.message import compose
from server.http.auth import Reader, ServiceOf, Taker
from server.http.schemas import CalibrationList, NewCalibration
from server.services.records import CalibrationOut
from server.wire.multipart import check_length, described_form, receive_calibration_pictures
from server.wire.patience import IDLE_TIMEOUT_S, with_idle_timeout
from server.wire.problems import Problem, Responses, documented, sent_file
from server.wire.send_file import send_file

router = APIRouter(prefix="/v1/calibrations", tags=["calibrations"])
JSON_BYTES = 1 << 20

BODY = described_form(
    "archive of IMAGES/ and board.toml; from a scene of photographs, and scale.json",
    ("label",),
    **{"from": "board (without it), or scene: the photographs show no board"},
)
BODY["requestBody"]["content"]["application/json"] = {"schema": NewCalibration.model_json_schema()}


@router.post("", status_code=202, responses=documented(400, 404, 408, 413, 415, 507), openapi_extra=BODY)
async def make_calibration(service: ServiceOf, caller: Taker, request: Request, response: Response) -> CalibrationOut:
    """Queues a calibration of an uploaded archive (multipart), or of captures that the rig took (JSON). The pictures
    show the calibration board or, with ``"from": "scene"``, any scene."""
    if request.headers.get("content-type", "").partition(";")[0].strip() == "application/json":
        await service.threads.disk(check_length, request, service.store, service.settings)
        wanted = _parsed(await _small_body(request))
        shots = (wanted.board, wanted.captures, wanted.label, wanted.scale)
        made = await service.threads.check(service.calibrations.add_shots, *shots, key=caller.key)
    else:
        made = await receive_calibration_pictures(service, request, caller.key)
    response.headers["Location"] = f"/v1/calibrations/{made.id}"
    return made


@router.get("", responses=documented())
def list_calibrations(service: ServiceOf, caller: Reader) -> CalibrationList:
    """Lists all calibrations, newest first."""
    return CalibrationList(calibrations=service.calibrations.find())


@router.get("/{calibration_id}", responses=documented(404))
def get_calibration(service: ServiceOf, caller: Reader, calibration_id: str) -> CalibrationOut:
    """Returns a calibration: its state and, once it has succeeded, its figures and checks."""
    return service.calibrations.get(calibration_id)


FILE: Responses = {**sent_file("application/json"), **documented(404, 409, 416)}


@router.head("/{calibration_id}/cameras.json", include_in_schema=False)
@router.get("/{calibration_id}/cameras.json", responses=FILE, response_class=FileResponse)
def get_cameras(service: ServiceOf, caller: Reader, request: Request, calibration_id: str) -> Response:
    """Returns the calibrated cameras as cameras.json of a capture folder."""
    return send_file(request, service.calibrations.file(calibration_id, "cameras.json"))


@router.get(
    "/{calibration_id}/report.html",
    responses=FILE | {200: {"content": {"text/html": {"schema": {"type": "string"}}}}},
    response_class=FileResponse,
)
def get_report(service: ServiceOf, caller: Reader, request: Request, calibration_id: str) -> Response:
    """Returns a calibration's report as a self-contained HTML page: residuals, coverage, uncertainty."""
    return send_file(request, service.calibrations.file(calibration_id, "report.html"))


@router.delete("/{calibration_id}", status_code=204, responses=documented(404, 409))
def remove_calibration(service: ServiceOf, caller: Taker, calibration_id: str) -> None:
    """Removes a calibration's pictures and report. If the calibration is in use, its cameras stay in use."""
    service.calibrations.remove(calibration_id)


async def _small_body(request: Request) -> bytes:
    body = bytearray()
    async for chunk in with_idle_timeout(request.stream(), IDLE_TIMEOUT_S):
        body += chunk
        if len(body) > JSON_BYTES:
            raise Problem(413, "body-too-large", compose("json-body-too-large", bytes=JSON_BYTES))
    return bytes(body)


def _parsed(body: bytes) -> NewCalibration:
    try:
        return NewCalibration.model_validate(json.loads(body))
    except ValidationError as error:
        raise RequestValidationError(error.errors()) from error
    except (ValueError, RecursionError) as error:
        raise Problem(422, "invalid-request", compose("body-no-json"), [str(error)[:200]]) from error
