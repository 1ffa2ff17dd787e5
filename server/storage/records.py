"""Defines the records of the data folder and the job database, and a name for JSON objects of any shape.

A file becomes a frozen record when it is read; a file that lacks a field counts as damaged. Requests and results of
jobs stay mappings, since the job engine keeps them unchanged across upgrades of this program.
"""

from collections.abc import Mapping
from dataclasses import dataclass, field
from typing import Annotated, Any, Generic, Literal, NotRequired, TypedDict, TypeVar

from pydantic import BaseModel, Field, PlainSerializer, PlainValidator, TypeAdapter

from rig.acquisition.face_sighting import FaceSighting
from rig.acquisition.shot import Fault, read_fault
from rig.acquisition.verdict import ViewDocument
from rig.messages.message import Message, read_message

JsonObject = dict[str, Any]  # what HTTP takes and gives without a shape of its own
CaptureKind = Literal["shot", "board", "film"]
T = TypeVar("T")


def _read_fault(value: object) -> Fault:
    """Reads a fault; earlier versions stored its detail as text."""
    if isinstance(value, Fault):
        return value
    if not isinstance(value, Mapping) or not isinstance(value.get("code"), str):
        raise ValueError(f"no fault: {value!r:.80}")
    return read_fault(value)


def _write_fault(fault: Fault) -> dict[str, object]:
    document = fault.document()
    return {name: document[name] for name in ("code", "camera", "detail", "detail_message")}


StoredMessage = Annotated[
    Message,
    PlainValidator(lambda value: value if isinstance(value, Message) else read_message(value)),
    PlainSerializer(Message.document, return_type=dict[str, Any]),
]
StoredFault = Annotated[Fault, PlainValidator(_read_fault), PlainSerializer(_write_fault, return_type=dict[str, Any])]


@dataclass(frozen=True, slots=True)
class CameraSize:
    """Holds the name of a camera of a capture and the size of its pictures (px)."""

    name: str
    width: int
    height: int


@dataclass(frozen=True, slots=True)
class CaptureContent:
    """Holds the content of a capture's folder.

    ``inputs``: SHA-256 of every file; ``board``: whether the pictures show the calibration board and no head;
    ``frames``: those of a film, 0 for a shot; ``checks``: measurements of each camera's picture; ``warnings``: those of
    the calibration, if the cameras were found from the photographs; ``face``: findings on the subject's face (None if
    no search was made).
    """

    cameras: tuple[CameraSize, ...]
    front: str
    inputs: dict[str, str]
    bytes: int
    board: bool = False
    frames: int = 0
    faults: tuple[StoredFault, ...] = ()
    checks: Mapping[str, ViewDocument] = field(default_factory=dict)
    warnings: tuple[StoredMessage, ...] = ()
    face: FaceSighting | None = None


@dataclass(frozen=True, slots=True)
class CaptureRecord:
    """Holds a capture: its source, people's notes on it, its content, the certificate of its shot, and the verdict on
    it.

    ``frames``: those of a film, 0 for a shot; ``verdict``: None if the capture was not judged (the board, films,
    captures of earlier versions); ``faults``: the reasons for the verdict; ``warnings``: those of the calibration and
    remarks on the face; ``inputs``: SHA-256 of every file by name.
    """

    id: str
    created: str
    source: str
    session: str | None
    label: str
    expression: str
    cameras: tuple[CameraSize, ...]
    front: str
    inputs: dict[str, str]
    bytes: int
    features: bool
    shot: Mapping[str, object] | None = None
    board: bool = False
    frames: int = 0
    verdict: str | None = None
    faults: tuple[StoredFault, ...] = ()
    warnings: tuple[StoredMessage, ...] = ()
    tags: tuple[str, ...] = ()

    @property
    def kind(self) -> CaptureKind:
        """Returns what the pictures are: one shot of a head, of the calibration board, or a film of a head."""
        return "board" if self.board else "film" if self.frames else "shot"


@dataclass(frozen=True, slots=True)
class SessionRecord:
    """Holds a session: its label, which is the subject's name, and the note of the subject's consent."""

    id: str
    created: str
    label: str
    consent: str


@dataclass(frozen=True, slots=True)
class CalibrationRecord:
    """Holds a calibration that was requested. ``pictures``: number of pictures by camera; ``kind``: what the pictures
    show, board or scene."""

    id: str
    created: str
    source: str
    label: str
    pictures: dict[str, int]
    kind: str = "board"


@dataclass(frozen=True, slots=True)
class UploadRecord:
    """Holds a resumable upload. ``fields`` describe the future capture; ``length`` is in bytes, ``expires`` in seconds
    since 1970; ``capture`` is the capture's id, None until it was made."""

    id: str
    length: int
    fields: dict[str, str]
    key: str
    expires: float
    capture: str | None


@dataclass(frozen=True, slots=True)
class RigAdjustment:
    """Holds the settings of cameras, by name, and the lamps of a shot that the operator changed. A None stands for the
    value of rig.toml."""

    cameras: dict[str, dict[str, float | None]]
    lights: tuple[int, ...] | None = None


class RecordFormat(Generic[T]):
    """Writes and reads records of one class as JSON objects whose key ``format`` names them."""

    def __init__(self, kind: type[T], name: str) -> None:
        self._adapter, self.name = TypeAdapter(kind), name

    def document(self, record: T) -> dict[str, object]:
        """Returns the JSON object of a record."""
        return {"format": self.name, **self._adapter.dump_python(record, mode="json")}

    def read(self, document: object) -> T:
        """Reads a record from its document. Raises ValueError for a document of another format or shape."""
        if not isinstance(document, dict) or document.get("format") != self.name:
            raise ValueError(f"no {self.name}")
        return self._adapter.validate_python(document)


CAPTURE = RecordFormat(CaptureRecord, "eigenhead-capture/1")
SESSION = RecordFormat(SessionRecord, "eigenhead-session/1")
CALIBRATION = RecordFormat(CalibrationRecord, "eigenhead-calibration/1")
RIG_ADJUSTMENT = RecordFormat(RigAdjustment, "eigenhead-rig-adjustment/1")
UPLOAD = RecordFormat(UploadRecord, "eigenhead-upload/1")


class SubjectOut(BaseModel):
    """Describes the subject's place in a picture. (A person of the library is ``PersonOut``.)"""

    share: float = Field(description="of the picture's area")
    cut_off: list[str] = Field(description="edges of the picture that cut the head: top, left, right")
    outline: list[list[float]] = Field(description="corners, in pixels of the picture")


class ViewChecksOut(BaseModel):
    """Holds the measurements of one camera's picture."""

    mean: float | None = Field(None, description="mean value, 0 to 255")
    clipped_share: float | None = Field(None, description="of pixels at 255 in every channel")
    blur_px: float | None = Field(None, description="standard deviation of the edge spread")
    background_found: float | None = Field(None, description="share of the clean plate's patches that were found")
    background_moved_px: float | None = None
    subject: SubjectOut | None = None


_CHECKS = TypeAdapter(dict[str, ViewChecksOut])


def read_checks(document: Any) -> dict[str, ViewDocument]:
    """Returns the measurements in a ``checks.json`` by camera. Raises ValueError for a document of another shape."""
    _CHECKS.validate_python(document)
    return document


class JobWebhook(TypedDict):
    """Holds the address to which the end of one job is announced. ``secret`` signs the messages; without ``secret`` the
    messages are not signed."""

    url: str
    secret: str | None


class JobRequest(TypedDict):
    """Holds the request for a job, as the job engine stores it. ``frames``: of the film that it tracks."""

    capture_id: str
    model: str | None
    settings: Mapping[str, object]
    restart_of: NotRequired[str]
    name: NotRequired[str]
    webhook: NotRequired[JobWebhook]
    deliver_to: NotRequired[str]
    frames: NotRequired[int]


class DeliveryRequest(TypedDict):
    """Holds the destination of a job's result, as the job engine stores it. ``to`` ends with a slash; ``until``: when
    to give up (s since 1970); ``webhook``: the job's own webhook."""

    job_id: str
    to: str
    until: float
    webhook: NotRequired[JobWebhook]


class FileEntry(TypedDict):
    """Holds size and SHA-256 of a result's file, as the job engine stores them."""

    bytes: int
    sha256: str


class WebhookMessage(TypedDict):
    """Holds one message to a webhook, about a job or a batch, as the job engine stores it. ``own``: the address, if the
    message goes to a job's own webhook."""

    webhook: str
    own: NotRequired[JobWebhook]
    type: str
    job_id: NotRequired[str]
    batch_id: NotRequired[str]
    delivered_to: NotRequired[str]
    id: str


class EventDocument(TypedDict, total=False):
    """Holds one event of a job: its stage, with progress (0 to 1) and remaining time (s) of the whole job, or a new
    state. ``camera_moved``: cameras that no longer have their calibrated poses; ``frames``: of a film, and how many of
    them are done."""

    state: str
    stage: str
    progress: float
    eta_s: float | None
    camera_moved: list[str]
    frames: int
    frames_done: int
