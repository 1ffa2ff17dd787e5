"""Defines the JSON documents about calibrations."""

from typing import Literal

from pydantic import ConfigDict, Field, model_validator

from server.http.schemas import EXAMPLE_ID, Answer, Id, JobError, MessageOut, Moment, Received, State, Text, Texts
from server.storage.records import JsonObject


class NewCalibration(Received):
    """Requests a calibration from shots that the rig took of the board or, from a scene, of anything."""

    model_config = ConfigDict(
        json_schema_extra={
            "examples": [
                {"board": {"kind": "charuco", "columns": 12, "rows": 9, "square_mm": 30.0}, "captures": [EXAMPLE_ID]},
                {
                    "from": "scene",
                    "scale": {"tag": {"dictionary": "DICT_4X4_50", "size_mm": 40.0}},
                    "captures": [EXAMPLE_ID],
                },
            ]
        }
    )

    source: Literal["board", "scene"] = Field("board", alias="from", description="scene: the pictures show no board")
    board: JsonObject | None = Field(None, description="as board.toml: kind, columns, rows, square_mm, ...")
    scale: JsonObject | None = Field(None, description="from a scene, as scale.json: a known length")
    captures: list[Id] = Field(min_length=1, max_length=500)
    label: Text = ""

    @model_validator(mode="after")
    def _of_one_kind(self) -> "NewCalibration":
        if self.source == "board" and (self.board is None or self.scale is not None):
            raise ValueError("from a board wants board, and no scale")
        if self.source == "scene" and self.board is not None:
            raise ValueError("from a scene takes no board")
        return self


class UseCalibration(Received):
    """Selects the calibration that the rig uses from now on."""

    model_config = ConfigDict(json_schema_extra={"examples": [{"calibration_id": EXAMPLE_ID}]})

    calibration_id: Id
    poor: bool = Field(False, description="use it although its verdict is poor")


class CalibrationOut(Answer):
    """Describes a calibration: the state of its job and, once it has succeeded, figures, checks and the verdict.
    ``progress`` runs from 0 to 1; ``eta_s`` is the estimated remaining time in seconds."""

    id: str
    created: Moment
    source: Literal["upload", "rig"]
    label: str
    pictures: dict[str, int] = Field(description="number of pictures by camera")
    kind: Literal["board", "scene"] = Field("board", description="what the pictures show")
    state: State
    stage: str | None = None
    progress: float = Field(0.0, ge=0, le=1)
    eta_s: float | None = None
    error: JobError | None
    verdict: Literal["good", "usable", "poor"] | None = Field(None, description="null: not judged")
    missing: Texts = Field([], description="what would make the verdict better, most urgent first")
    missing_messages: list[MessageOut] = Field([], validation_alias="missing")
    figures: JsonObject
    checks: list[JsonObject]
    warnings: Texts
    warning_messages: list[MessageOut] = Field(validation_alias="warnings")
    front: str | None
    in_use: bool


class CalibrationList(Answer):
    """Holds all calibrations, newest first."""

    calibrations: list[CalibrationOut]
