"""Defines HTTP documents: requests about captures, sessions, jobs, the rig and calibrations, and the answers for
captures, results and lists."""

import base64
import binascii
from typing import Annotated, Literal

from fastapi import Header, Query
from pydantic import AfterValidator, BaseModel, BeforeValidator, ConfigDict, Field, model_validator
from pydantic_core import PydanticCustomError

from rig.acquisition.verdict import Verdict
from server.services.answer import Answer, JobSettings, MessageOut, Moment, Said, as_data
from server.services.records import CalibrationOut, FileOut, JobOut, PersonOut, SessionOut
from server.services.texts import PLAIN, TAG_MOST, TAGS_MOST, TEXT_MOST
from server.storage.records import CaptureKind, JsonObject, ViewChecksOut

Id = Annotated[str, Field(pattern="^[0-9a-f]{28}$", description="28 hex digits")]
Text = Annotated[str, Field(max_length=TEXT_MOST, pattern=PLAIN)]
Tag = Annotated[str, Field(min_length=1, max_length=TAG_MOST, pattern="^[^\\x00-\\x1f\\x7f,]*$")]
Tags = Annotated[list[Tag], Field(max_length=TAGS_MOST, description="without commas and control characters")]
Idempotency = Annotated[str | None, Header(alias="Idempotency-Key", min_length=1, max_length=200)]
EXAMPLE_ID = "0198c0de" + 20 * "0"
Limit = Annotated[int, Query(ge=1, le=1000)]
Cursor = Annotated[str | None, Query(max_length=2000, description="``next`` of the page before, in the same order")]
Key = Annotated[str | None, Query(max_length=64, pattern=PLAIN)]
WithTag = Annotated[
    str | None, Query(max_length=200, pattern=PLAIN, description="only what bears this tag, in whatever case")
]
Sought = Annotated[str, Query(max_length=200, pattern=PLAIN, description="words that must all be found")]


class WarningOut(MessageOut):
    """Holds a warning with its code and parameters, as in report.json."""

    code: str = Field(description="as in docs/operator.md, among them scale-assumed, view-left-out, views-many")


class Received(BaseModel):
    """Refuses unknown keys, as the base class of all request bodies."""

    model_config = ConfigDict(extra="forbid")


def example(*documents: JsonObject) -> ConfigDict:
    """Returns the configuration of a request whose OpenAPI description shows these examples."""
    return ConfigDict(json_schema_extra={"examples": [*documents]})


class NewSession(Received):
    """Begins a session of one subject."""

    model_config = example({"label": "Anna", "consent": "signed 2026-03-01, for research"})

    label: Text = ""
    consent: Text = Field("", description="note on the subject's consent")


class NewCapture(Received):
    """Requests a shot with the rig."""

    model_config = example({"label": "Anna", "expression": "neutral"})

    session: Id | None = None
    label: Text = ""
    expression: Text = ""
    tags: Tags = Field(default_factory=list)
    seed: int | None = Field(None, ge=0, lt=2**31, description="subject and noise of the simulated studio")
    board: bool = Field(False, description="of the calibration board: needs no calibration, cannot be reconstructed")


class NewImport(Received):
    """Requests a capture from an archive on another server."""

    model_config = example({"url": "https://store.example/anna.tar.gz"})

    url: str = Field(
        max_length=2000,
        description="of an archive of a capture, at a server or in a store (s3://) that the operator allowed",
    )
    session: Id | None = None
    label: Text = ""
    expression: Text = ""
    tags: Tags = Field(default_factory=list)


class SessionEdit(Received):
    """Changes the label or the consent note of a session. Keys that the request leaves out keep their values."""

    model_config = example({"label": "Anna B."})

    label: Text | None = None
    consent: Text | None = None


class CaptureEdit(Received):
    """Changes a capture. Keys that the request leaves out keep their values; ``"session": null`` removes the capture
    from its session."""

    model_config = example({"expression": "smile"})

    session: Id | None = None
    label: Text | None = None
    expression: Text | None = None
    tags: Tags = Field(default_factory=list, description="in place of those before")


class NewFeatures(Received):
    """Holds feature points: for each point the pixel in each camera that shows it."""

    model_config = example({"points": {"pronasale": {"cam00": [511.2, 402.7], "cam03": [433.0, 398.1]}}})

    format: Literal["eigenhead-features/1"] = "eigenhead-features/1"
    points: dict[str, dict[str, list[float]]]


def _decodes(secret: str) -> str:
    try:
        base64.b64decode(secret.removeprefix("whsec_"), validate=True)
    except binascii.Error as error:
        fault = "is no base64 after whsec_: it has a number of characters that no bytes have, or lacks its = at the end"
        raise PydanticCustomError("secret", fault) from error
    return secret


Secret = Annotated[str, Field(pattern="^whsec_[A-Za-z0-9+/]{32,}={0,2}$"), AfterValidator(_decodes)]


class JobWebhook(Received):
    """Names an address to which the end of one job is announced."""

    url: str = Field(pattern="^https?://", max_length=2000, description="at a server that the operator allowed")
    secret: Secret | None = Field(None, description="signs the messages (standardwebhooks.com)")


DeliverTo = Annotated[str, Field(pattern="^(s3|file)://[^\\x00-\\x1f\\x7f]*$", max_length=1000)]
DELIVER_TO = "where the result is delivered to, in a folder of the job's id; a place that the operator allowed"


class NewJob(Received):
    """Requests a reconstruction of a capture."""

    model_config = example(
        {
            "capture_id": EXAMPLE_ID,
            "name": "Anna, fine",
            "settings": {"detail": "fine", "outputs": {"formats": ["glb", "obj"]}},
        }
    )

    capture_id: Id
    name: Text = Field("", description="for people; need not be unique")
    webhook: JobWebhook | None = None
    deliver_to: DeliverTo | None = Field(None, description=DELIVER_TO, examples=["s3://studio/heads/"])
    model: str | None = Field(None, max_length=200)
    settings: JobSettings | None = Field(None, description="of the pipeline; what is not given has its default")
    queue: str | None = Field(None, max_length=32)
    priority: int = Field(100, ge=1, le=1000, description="lower goes first")


class NewSessionJobs(Received):
    """Requests a reconstruction of every capture of a session that shows a head."""

    model_config = example({"settings": {"detail": "fine"}})

    model: str | None = Field(None, max_length=200)
    settings: JobSettings | None = None
    priority: int = Field(100, ge=1, le=1000)


class Restart(Received):
    """Repeats a job. Keys that the request leaves out have the old job's values."""

    model_config = example({"settings": {"method": "simplex"}})

    model: str | None = Field(None, max_length=200)
    settings: JobSettings | None = None


class Size(Answer):
    """Describes a camera by its name and the size of its pictures in pixels."""

    name: str
    width: int
    height: int


class FaultOut(Answer):
    """Describes a fault of a capture that was accepted."""

    code: str = Field(description="as in docs/rig.md, among them moved, overexposed, blurred, setting, plates, cut-off")
    camera: str | None = Field(description="null: the rig as a whole")
    detail: Said
    detail_message = as_data("detail")
    remedy: Said


class CaptureOut(Answer):
    """Describes a capture: its pictures, people's notes on it, and the verdict on it."""

    id: str
    created: Moment
    source: Literal["upload", "rig"]
    session: str | None
    label: str
    expression: str
    cameras: list[Size]
    front: str
    features: bool
    kind: CaptureKind = Field(description="board: of the calibration board, cannot be reconstructed; film: is tracked")
    frames: int = Field(0, description="of a film; 0: one shot")
    board: bool = Field(False, description="pictures of the calibration board, which cannot be reconstructed")
    bytes: int
    inputs: dict[str, str] = Field(description="sha256 of every file, by name")
    shot: JsonObject | None = Field(None, description="the rig's sync certificate")
    verdict: Verdict | None = Field(
        None, description="good: no fault; poor: shoot again; null: not judged (board, film, earlier version)"
    )
    faults: list[FaultOut] = Field(default_factory=list, description="every fault that the verdict follows from")
    warnings: list[WarningOut] = Field(
        default_factory=list, description="of cameras that were found from the photographs; report.json repeats them"
    )
    tags: list[str] = Field(default_factory=list, description="what people find it by")


class ResultFile(FileOut):
    """Describes a file of a result and where to fetch it."""

    name: str = Field(description="below the result folder, such as overlays/cam00.png")
    url: str
    media_type: str


class ResultList(Answer):
    """Holds the files of a job's result."""

    job_id: str
    files: list[ResultFile]


class Listed(Answer):
    """Holds one page of a list."""

    next: str | None = Field(None, description="cursor of the page after this one; null on the last")
    total: int = Field(ge=0, description="how many all pages hold")


class CaptureList(Listed):
    """Holds one page of captures."""

    captures: list[CaptureOut]


class SessionList(Listed):
    """Holds one page of sessions."""

    sessions: list[SessionOut]


class SubjectList(Listed):
    """Holds one page of people."""

    subjects: list[PersonOut]


class JobList(Listed):
    """Holds one page of jobs."""

    jobs: list[JobOut]


class JobBatch(Answer):
    """Holds the jobs that one request has queued, one for each capture."""

    jobs: list[JobOut]


Ids = Annotated[list[Id], Field(min_length=1, max_length=1000)]


class CaptureBulk(Received):
    """Requests one action on many captures. Each capture succeeds or is refused independently."""

    model_config = example({"action": "remove", "ids": [EXAMPLE_ID]})

    action: Literal["remove", "erase", "reconstruct", "move", "tag", "untag"] = Field(
        description="remove: pictures go, heads stay; erase: nothing stays; reconstruct: a job each; move: to a "
        "session; tag, untag: adds or takes away tags"
    )
    ids: Ids
    session: Id | None = Field(None, description="of move; null: out of any")
    tags: Tags = Field(default_factory=list, description="of tag and untag")
    model: str | None = Field(None, max_length=200, description="of reconstruct")
    settings: JobSettings | None = Field(None, description="of reconstruct")


class JobBulk(Received):
    """Requests one action on many jobs. Each job succeeds or is refused independently."""

    model_config = example({"action": "cancel", "ids": [EXAMPLE_ID]})

    action: Literal["cancel", "restart", "remove"]
    ids: Ids


class NewExport(Received):
    """Requests a job's head in another format."""

    model_config = example({"as": "obj"})

    form: Literal["glb", "ply", "obj", "usdz", "stl", "3mf"] = Field(alias="as")
    template: str | None = Field(None, description="also head-NAME.obj, in this template's vertex order", max_length=40)
    morphs: bool = Field(False, description="also posed.glb, with shapes, eyes and teeth")
    albedo: bool = Field(False, description="also texture/albedo.png")

    def outputs(self) -> dict[str, object]:
        """Returns the equivalent settings of the pipeline's outputs."""
        albedo = "file" if self.albedo else "none"
        return {"formats": [self.form], "template": self.template, "morphs": self.morphs, "albedo": albedo}


class NewDelivery(Received):
    """Requests that a job's result is delivered to an object store."""

    model_config = example({"to": "s3://studio/heads/"})

    to: DeliverTo | None = Field(None, description=f"{DELIVER_TO}; left out, the one that the job was submitted with")


class CameraSettingsEdit(Received):
    """Changes a camera's settings. A key that the request leaves out keeps its value. For a key that is null the
    service no longer sets a value, and the camera keeps its current value."""

    model_config = example({"exposure_ms": 8.0, "gain_db": 0.0})

    exposure_ms: float | None = Field(None, ge=0.001, le=60_000)
    gain_db: float | None = Field(None, ge=-60, le=60)
    white_balance_k: int | None = Field(None, ge=1000, le=20_000)


class Lights(Received):
    """Holds which lamps are on during a shot."""

    model_config = example({"outputs": [0, 1]})

    outputs: list[Annotated[int, Field(ge=0, le=3)]] = Field(
        max_length=4, description="light outputs of the trigger box that are on during a shot"
    )


class CaptureChecks(Answer):
    """Holds the measurements of each camera's picture, by camera; empty for captures of earlier versions."""

    cameras: dict[str, ViewChecksOut]


class PlatesOut(Answer):
    """Describes a stored version of the clean plates."""

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

    model_config = example({"version": "20261122T215052123456Z"})

    version: str = Field(max_length=64, description="an id of GET /v1/rig/background")


class BackgroundOut(Answer):
    """Describes the clean plates that were just taken: the cameras, and how many pictures each camera took."""

    cameras: list[str]
    plates: int
    note: Annotated[str, BeforeValidator(lambda note: "" if note is None else str(note))]
    note_message: MessageOut | None = Field(None, validation_alias="note")


class NewCalibration(Received):
    """Requests a calibration from the rig's shots of the calibration board or of any scene."""

    model_config = example(
        {"board": {"kind": "charuco", "columns": 12, "rows": 9, "square_mm": 30.0}, "captures": [EXAMPLE_ID]},
        {"from": "scene", "scale": {"tag": {"dictionary": "DICT_4X4_50", "size_mm": 40.0}}, "captures": [EXAMPLE_ID]},
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

    model_config = example({"calibration_id": EXAMPLE_ID})

    calibration_id: Id
    poor: bool = Field(False, description="use it although its verdict is poor")


class CalibrationList(Answer):
    """Holds all calibrations, newest first."""

    calibrations: list[CalibrationOut]
