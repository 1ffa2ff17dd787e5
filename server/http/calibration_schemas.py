"""Defines the JSON documents about calibrations."""

from typing import Literal

from pydantic import ConfigDict, Field, model_validator

from server.http.schemas import EXAMPLE_ID, Id, Received, Text
from server.services.answer import Answer
from server.services.records import CalibrationOut
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


class CalibrationList(Answer):
    """Holds all calibrations, newest first."""

    calibrations: list[CalibrationOut]
