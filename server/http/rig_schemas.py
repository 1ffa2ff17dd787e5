"""Defines the JSON documents about the rig's pictures: their checks, what a capture holds, and clean plates."""

from typing import Annotated

from pydantic import BeforeValidator, ConfigDict, Field

from server.http.message_schemas import MessageOut, Texts
from server.http.schemas import Answer, Moment, Received


class SubjectOut(Answer):
    share: float = Field(description="of the picture's area")
    cut_off: list[str] = Field(description="edges of the picture that cut the head: top, left, right")
    outline: list[list[float]] = Field(description="corners, in pixels of the picture")


class ViewChecksOut(Answer):
    """Holds what was measured on one camera's picture."""

    mean: float | None = Field(None, description="mean value, 0 to 255")
    clipped_share: float | None = Field(None, description="of pixels at 255 in every channel")
    blur_px: float | None = Field(None, description="standard deviation of the edge spread")
    background_found: float | None = Field(None, description="share of the clean plate's patches that were found")
    background_moved_px: float | None = None
    subject: SubjectOut | None = None


class CaptureChecks(Answer):
    cameras: dict[str, ViewChecksOut]


class HoldingsOut(Answer):
    """Lists what is stored of a capture. A removal deletes the pictures, an erasure everything."""

    pictures: int
    bytes: int = Field(description="of images, clean plates and caches")
    heads: list[str] = Field(description="jobs whose results stay after a removal, photographs in their overlays too")
    head_bytes: int
    jobs: list[str] = Field(description="the other jobs")
    active: list[str] = Field(description="jobs that are queued or running: a removal is refused, an erasure ends them")


class PlatesOut(Answer):
    """Describes a set of stored clean plates."""

    id: str
    taken: Moment
    cameras: list[str]
    refused: Texts = Field(description="why they were not put to use")
    refused_messages: list[MessageOut] = Field(validation_alias="refused")
    in_use: bool


class PlatesList(Answer):
    versions: list[PlatesOut]


class UsePlates(Received):
    model_config = ConfigDict(json_schema_extra={"examples": [{"version": "20261122T215052123456Z"}]})

    version: str = Field(max_length=64, description="an id of GET /v1/rig/background")


class BackgroundOut(Answer):
    cameras: list[str]
    plates: int
    note: Annotated[str, BeforeValidator(lambda note: "" if note is None else str(note))]
    note_message: MessageOut | None = Field(None, validation_alias="note")
