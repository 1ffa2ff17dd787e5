"""The rig: its state, a live view, clean plates, the calibration in use."""

from typing import Annotated

from fastapi import APIRouter, Depends, Response

from server.http.auth import ServiceOf, require
from server.http.rig_schemas import PlatesList, PlatesOut, UsePlates
from server.http.schemas import BackgroundOut, RigOut, UseCalibration
from server.services.keys import Caller
from server.wire.problems import documented

router = APIRouter(prefix="/v1/rig", tags=["rig"])
Reader = Annotated[Caller, Depends(require("read"))]
Taker = Annotated[Caller, Depends(require("capture"))]


@router.get("", responses=documented())
def rig_state(service: ServiceOf, caller: Reader) -> RigOut:
    """Cameras, drivers, faults, and whether it is calibrated."""
    return RigOut.model_validate(service.rig.describe())


@router.get(
    "/cameras/{name}/preview.jpg",
    response_class=Response,
    responses={200: {"content": {"image/jpeg": {}}}, **documented(404)},
)
def rig_preview(service: ServiceOf, caller: Reader, name: str) -> Response:
    """What the camera sees now."""
    return Response(service.rig.preview(name), media_type="image/jpeg", headers={"Cache-Control": "no-store"})


@router.post("/background", responses=documented(409, 507))
def take_background(service: ServiceOf, caller: Taker) -> BackgroundOut:
    """Takes new clean plates of the empty studio. The old ones stay if that fails (503), or if the new ones show
    somebody whom the old ones do not (409): those are kept, and PUT puts them to use all the same."""
    service.store.reserve(0, service.settings.free_bytes)
    return BackgroundOut.model_validate(service.rig.take_background())


@router.get("/background", responses=documented())
def list_plates(service: ServiceOf, caller: Reader) -> PlatesList:
    """The clean plates that are kept, newest first: those in use, earlier ones, and those that were refused."""
    return PlatesList(versions=[PlatesOut.model_validate(kept) for kept in service.rig.plates()])


@router.put("/background", responses=documented(400, 404, 413, 415, 507))
def use_plates(service: ServiceOf, caller: Taker, wanted: UsePlates) -> PlatesList:
    """Puts clean plates that are kept to use: earlier ones, which takes the newest back, or refused ones all the
    same."""
    service.rig.use_plates(wanted.version)
    return list_plates(service, caller)


@router.put("/calibration", responses=documented(400, 404, 409, 413, 415, 507))
def use_calibration(service: ServiceOf, caller: Taker, wanted: UseCalibration) -> RigOut:
    """Every capture from now on gets this calibration."""
    return RigOut.model_validate(service.use_calibration(wanted.calibration_id))
