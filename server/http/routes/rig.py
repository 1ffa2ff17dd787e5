"""Declares the routes of the rig: its state, live view, settings of cameras and lamps, clean plates, calibration in
use."""

from collections.abc import AsyncIterator
from contextlib import suppress
from typing import Annotated

import anyio
from fastapi import APIRouter, Query, Response
from fastapi.responses import StreamingResponse

from server.errors import Unavailable
from server.http.auth import Reader, ServiceOf, Taker
from server.http.schemas import (
    BackgroundOut,
    CameraSettingsEdit,
    Lights,
    PlatesList,
    PlatesOut,
    UseCalibration,
    UsePlates,
)
from server.services.records import CameraSettingsOut, RigOut
from server.services.service import Service
from server.wire.problems import documented

router = APIRouter(prefix="/v1/rig", tags=["rig"])
PARTS = "multipart/x-mixed-replace; boundary=frame"
PICTURE_EVERY_S = 0.25
UNKEPT = {"Cache-Control": "no-store"}


@router.get("", responses=documented())
def rig_state(service: ServiceOf, caller: Reader) -> RigOut:
    """Returns the cameras, drivers and faults of the rig, and whether it is calibrated."""
    return service.rig.describe()


@router.get(
    "/cameras/{name}/preview.jpg",
    response_class=Response,
    responses={200: {"content": {"image/jpeg": {}}}, **documented(404)},
)
def rig_preview(service: ServiceOf, caller: Reader, name: str) -> Response:
    """Returns a camera's current picture, at most 640 pixels wide."""
    return Response(service.rig.preview(name), media_type="image/jpeg", headers=UNKEPT)


@router.get(
    "/cameras/{name}/preview.mjpg",
    response_class=StreamingResponse,
    responses={200: {"content": {PARTS: {"schema": {"type": "string", "format": "binary"}}}}, **documented(404)},
)
async def rig_preview_stream(
    service: ServiceOf,
    caller: Reader,
    name: str,
    seconds: Annotated[float, Query(gt=0, le=3600, description="after which it ends")] = 600.0,
) -> Response:
    """Streams the camera's picture four times a second as motion JPEG, for a page's ``<img>`` or a video player."""
    first = await service.threads.disk(service.rig.preview, name)  # raises its 404 or 503 before the stream begins
    return StreamingResponse(_pictures(service, name, first, seconds), media_type=PARTS, headers=UNKEPT)


async def _pictures(service: Service, name: str, picture: bytes, seconds: float) -> AsyncIterator[bytes]:
    until = anyio.current_time() + seconds
    while True:
        began = anyio.current_time()
        yield b"--frame\r\nContent-Type: image/jpeg\r\nContent-Length: %d\r\n\r\n%b\r\n" % (len(picture), picture)
        with suppress(Unavailable):  # of a camera that is gone for a moment the last picture stays
            picture = await service.threads.disk(service.rig.preview, name)
        await anyio.sleep(max(0.0, began + PICTURE_EVERY_S - anyio.current_time()))
        if anyio.current_time() >= until:
            return


@router.get("/cameras/{name}/settings", responses=documented(404))
def camera_settings(service: ServiceOf, caller: Reader, name: str) -> CameraSettingsOut:
    """Returns the exposure, gain and white balance requested of a camera, and which of these it did not accept."""
    return service.rig.camera_settings(name)


@router.patch("/cameras/{name}/settings", responses=documented(400, 404, 409, 413, 415, 507))
def set_camera(service: ServiceOf, caller: Taker, name: str, wanted: CameraSettingsEdit) -> CameraSettingsOut:
    """Changes settings of a camera, also for later starts of the service; afterwards the rig needs new clean plates.
    Answers 409 in the simulated studio."""
    return service.rig.set_camera(name, wanted.model_dump(exclude_unset=True))


@router.get("/lights", responses=documented())
def rig_lights(service: ServiceOf, caller: Reader) -> Lights:
    """Returns the lamps that are on during a shot."""
    return Lights(outputs=list(service.rig.lights()))


@router.put("/lights", responses=documented(400, 409, 413, 415, 507))
def set_lights(service: ServiceOf, caller: Taker, wanted: Lights) -> Lights:
    """Selects the lamps that are on during a shot, also for later starts of the service; afterwards the rig needs new
    clean plates. Answers 409 in the simulated studio."""
    return Lights(outputs=list(service.rig.set_lights(tuple(sorted(set(wanted.outputs))))))


@router.post("/background", responses=documented(409, 507))
def take_background(service: ServiceOf, caller: Taker) -> BackgroundOut:
    """Takes new clean plates of the empty studio and uses them for later captures.

    If taking the plates fails (503), or if the new plates show a person whom the old plates do not show (409), the old
    plates stay in use. After a 409 the new plates are stored, and ``PUT`` can still select them.
    """
    service.store.reserve(0, service.settings.free_bytes)
    return BackgroundOut.model_validate(service.rig.take_background())


@router.get("/background", responses=documented())
def list_plates(service: ServiceOf, caller: Reader) -> PlatesList:
    """Lists the stored clean plates, newest first: the plates in use, earlier plates, and refused plates."""
    return PlatesList(versions=[PlatesOut.model_validate(kept) for kept in service.rig.plates()])


@router.put("/background", responses=documented(400, 404, 413, 415, 507))
def use_plates(service: ServiceOf, caller: Taker, wanted: UsePlates) -> PlatesList:
    """Selects stored clean plates for later captures, which may be earlier plates or refused plates."""
    service.rig.use_plates(wanted.version)
    return list_plates(service, caller)


@router.put("/calibration", responses=documented(400, 404, 409, 413, 415, 507))
def use_calibration(service: ServiceOf, caller: Taker, wanted: UseCalibration) -> RigOut:
    """Selects the calibration of every later capture. Answers 409, with the reasons, for a calibration whose verdict is
    poor, unless ``poor`` is set."""
    return service.use_calibration(wanted.calibration_id, poor=wanted.poor)
