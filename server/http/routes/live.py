"""Declares the route of the live head: lamps of the cameras, the head of whoever sits before them, what is to do."""

from collections.abc import AsyncIterator
from typing import Annotated

import anyio
from fastapi import APIRouter, Depends, Header, Query, Response
from fastapi.responses import StreamingResponse

from server.http.auth import ServiceOf, require
from server.http.schemas import Answer, MessageOut
from server.services.keys import Caller
from server.services.live.seen import LiveShown, Word
from server.services.service import Service
from server.wire.problems import documented

router = APIRouter(prefix="/v1/rig", tags=["rig"])
Reader = Annotated[Caller, Depends(require("read"))]
EVENTS = "text/event-stream"
LOOK_S = 0.05
UNKEPT = {"Cache-Control": "no-store"}
Point = list[float]


class LampsOut(Answer):
    """Tells of one camera whether it shows the face, is sharp, well exposed and has the head in its middle, and whether
    the face looks at it. null: not known, or it need not be."""

    face: bool | None
    sharp: bool | None
    exposed: bool | None
    centred: bool | None
    looking: bool | None
    points: list[Point] = []  # noqa: RUF012 - pydantic copies it


class HeadOut(Answer):
    """Describes the head. ``rotation`` (row by row) and ``translation`` (mm): of world_from_head; ``scale``: by the
    model's mean size; ``left_deg``, ``up_deg``: where the face looks, seen from the front camera; ``right_mm``,
    ``down_mm``, ``away_mm``: how far the head is, in the front camera's picture, from where all cameras look;
    ``vertices`` (mm, in the same directions) and ``triangles``: a small mesh."""

    rotation: Point
    translation: Point
    scale: float
    left_deg: float
    up_deg: float
    right_mm: float
    down_mm: float
    away_mm: float
    openings: dict[str, float]
    eyes_open: bool | None
    vertices: list[Point]
    triangles: list[list[int]]


class WordOut(Answer):
    """Says one thing to do. ``camera``: that it is about, null for the subject."""

    code: str
    text: str
    camera: str | None
    message: MessageOut


class LiveOut(Answer):
    """Describes the newest look. ``time``: when its pictures were taken, empty before the first; ``age_s``: how old
    they were when the head was ready; ``points`` of ``cameras``: landmarks of the face, as shares of width and height;
    ``ready``: the head is steady, its eyes are open, and nothing is to do."""

    time: str
    age_s: float
    number: int
    cameras: dict[str, LampsOut]
    head: HeadOut | None
    steady: bool
    words: list[WordOut]
    ready: bool


def word_of(word: Word) -> WordOut:
    """Returns a word as HTTP answers it."""
    message = word.message
    return WordOut(code=message.code, text=message.text, camera=word.camera, message=MessageOut.model_validate(message))


def described(shown: LiveShown) -> LiveOut:
    """Returns a look as HTTP answers it."""
    head = None if shown.head is None else HeadOut.model_validate(shown.head)
    cameras = {name: LampsOut.model_validate(lamps) for name, lamps in shown.cameras.items()}
    words = [word_of(word) for word in shown.words]
    return LiveOut(
        time=shown.time,
        age_s=shown.age_s,
        number=shown.number,
        cameras=cameras,
        head=head,
        steady=shown.steady,
        words=words,
        ready=shown.ready,
    )


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
    """Returns the head that sits before the cameras, lamps of each camera, and what is to do before a shot.

    The cameras are looked at while somebody asks, so the first answers have no head. With ``Accept: text/event-stream``
    every look is sent as an event ``look``."""
    if EVENTS in accept:
        return StreamingResponse(_events(service, seconds), media_type=EVENTS, headers=UNKEPT)
    response.headers.update(UNKEPT)
    return described(service.live.newest())


async def _events(service: Service, seconds: float) -> AsyncIterator[str]:
    until, sent = anyio.current_time() + seconds, -1
    while anyio.current_time() < until:
        shown = service.live.newest()
        if shown.number != sent:
            sent = shown.number
            yield f"event: look\nid: {sent}\ndata: {described(shown).model_dump_json()}\n\n"
        await anyio.sleep(LOOK_S)
