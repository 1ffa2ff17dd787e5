"""Defines the JSON documents about the rig, its cameras and clean plates, and about what a capture's pictures show."""

from typing import Annotated

from pydantic import BeforeValidator, ConfigDict, Field

from server.http.schemas import Received
from server.services.answer import Answer, MessageOut, Moment, Said, as_data


class CameraSettingsEdit(Received):
    """Changes a camera's settings. A key that is left out keeps its value. With null the service no longer sets the
    value, and the camera keeps the one that it has."""

    model_config = ConfigDict(json_schema_extra={"examples": [{"exposure_ms": 8.0, "gain_db": 0.0}]})

    exposure_ms: float | None = Field(None, ge=0.001, le=60_000)
    gain_db: float | None = Field(None, ge=-60, le=60)
    white_balance_k: int | None = Field(None, ge=1000, le=20_000)


class Lights(Received):
    """Holds which lamps are on during a shot."""

    model_config = ConfigDict(json_schema_extra={"examples": [{"outputs": [0, 1]}]})

    outputs: list[Annotated[int, Field(ge=0, le=3)]] = Field(
        max_length=4, description="light outputs of the trigger box that are on during a shot"
    )


class SubjectOut(Answer):
    """Describes where the subject is in a picture. (A person of the library is ``PersonOut``.)"""

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
    """Holds what was measured on each camera's picture, by camera. It is empty for captures of earlier versions."""

    cameras: dict[str, ViewChecksOut]


class PlatesOut(Answer):
    """Describes a version of the clean plates that is stored."""

    id: str
    taken: Moment
    cameras: list[str]
    refused: tuple[Said, ...] = Field(description="why they were not put to use")
    refused_messages = as_data("refused", list[MessageOut])
    in_use: bool


class PlatesList(Answer):
    """Holds all stored versions of the clean plates, newest first."""

    versions: list[PlatesOut]


class UsePlates(Received):
    """Selects a version of the clean plates."""

    model_config = ConfigDict(json_schema_extra={"examples": [{"version": "20261122T215052123456Z"}]})

    version: str = Field(max_length=64, description="an id of GET /v1/rig/background")


class BackgroundOut(Answer):
    """Describes the clean plates that were just taken: the cameras, and how many pictures of each."""

    cameras: list[str]
    plates: int
    note: Annotated[str, BeforeValidator(lambda note: "" if note is None else str(note))]
    note_message: MessageOut | None = Field(None, validation_alias="note")
