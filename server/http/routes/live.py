"""Declares the route of the live view of a subject's head, with indicator lamps for each camera, and instructions."""

from collections.abc import AsyncIterator
from typing import Annotated

import anyio
from fastapi import APIRouter, Header, Query, Response
from fastapi.responses import StreamingResponse

from server.http.auth import Reader, ServiceOf
from server.services.live.seen import LiveOut
from server.services.service import Service
from server.wire.problems import documented

router = APIRouter(prefix="/v1/rig", tags=["rig"])
EVENTS = "text/event-stream"
LOOK_S = 0.05
UNKEPT = {"Cache-Control": "no-store"}


@router.get(
    "/live",
    response_model=LiveOut,
    responses={200: {"content": {EVENTS: {"schema": {"type": "string"}}}}, **documented()},
)
def rig_live(
    service: ServiceOf,
    caller: Reader,
    response: Response,
    accept: Annotated[str, Header(max_length=1000)] = "",
    seconds: Annotated[float, Query(gt=0, le=3600, description="after which a stream ends")] = 600.0,
) -> Response | LiveOut:
    """Returns, before a shot, the subject's head, indicator lamps for each camera, and instructions.

    The cameras take pictures only while clients send requests, so the first answers have no head. With ``Accept:
    text/event-stream`` each new state is sent as an event ``look``."""
    if EVENTS in accept:
        return StreamingResponse(_events(service, seconds), media_type=EVENTS, headers=UNKEPT)
    response.headers.update(UNKEPT)
    return service.live.newest()


async def _events(service: Service, seconds: float) -> AsyncIterator[str]:
    until, sent = anyio.current_time() + seconds, -1
    while anyio.current_time() < until:
        shown = service.live.newest()
        if shown.number != sent:
            sent = shown.number
            yield f"event: look\nid: {sent}\ndata: {shown.model_dump_json()}\n\n"
        await anyio.sleep(LOOK_S)
