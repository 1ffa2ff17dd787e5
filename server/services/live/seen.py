"""Defines the findings of one set of pictures, in the child process and in the service, and the answer about them."""

from collections.abc import Mapping
from dataclasses import dataclass

from pydantic import Field

from rig.messages.message import Message
from server.services.answer import Answer, MessageOut

Numbers = tuple[float, ...]


@dataclass(frozen=True, slots=True)
class CameraSeen:
    """Holds the findings of one camera.

    Attributes:
        mean: of the picture, 0 to 255; ``light``: its brightness by the clean plate's; None without one.
        clipped: share of the picture at full white.
        blur_px: spread of edges on the face, pixels of a picture 640 wide; None where there are none to measure.
        facing: cosine between where the face looks and the camera; None without a head, as the next two.
        face: whether the head's face is found; None where it need not be, as it is turned away.
        centred: whether the whole head is in the picture, and the face in its middle part.
        stranger: whether a face is seen that is not the head's.
        points: some of the face's landmarks, as shares of the picture's width and height.
    """

    mean: float
    light: float | None
    clipped: float
    blur_px: float | None
    facing: float | None = None
    face: bool | None = None
    centred: bool | None = None
    stranger: bool = False
    points: tuple[Numbers, ...] = ()


class HeadOut(Answer):
    """Describes the head. ``rotation`` (row by row) and ``translation`` (mm): of world_from_head; ``scale``: relative
    to the model's mean size; ``left_deg``, ``up_deg``: direction of the face, seen from the front camera; ``right_mm``,
    ``down_mm``, ``away_mm``: the head's offset in the front camera's picture from the point that all cameras look at;
    ``vertices`` (mm, in the same directions) and ``triangles``: a small mesh."""

    rotation: Numbers
    translation: Numbers
    scale: float
    left_deg: float
    up_deg: float
    right_mm: float
    down_mm: float
    away_mm: float
    room_mm: float = Field(exclude=True)  # that it may be to a side,
    depth_mm: float = Field(exclude=True)  # and along the view
    openings: dict[str, float]  # of the lids, by side (``pipeline.faces.eyes``)
    eyes_open: bool | None  # None where they are not seen
    vertices: tuple[Numbers, ...]
    triangles: tuple[tuple[int, ...], ...]


@dataclass(frozen=True, slots=True)
class Seen:
    """Holds the findings of one set of pictures. ``faces``: whether some camera shows a face, even if no head was
    found; ``calibrated``: whether the cameras' poses are known; ``missing``: cameras that deliver no picture."""

    cameras: Mapping[str, CameraSeen]
    head: HeadOut | None
    faces: bool
    calibrated: bool
    missing: tuple[str, ...] = ()


class LampsOut(Answer):
    """States for one camera whether it shows the face, is sharp, is well exposed and has the head in its middle, and
    whether the face looks at it. null: unknown, or not required."""

    face: bool | None
    sharp: bool | None
    exposed: bool | None
    centred: bool | None
    looking: bool | None
    points: tuple[Numbers, ...] = ()


@dataclass(frozen=True, slots=True)
class Word:
    """Holds one instruction, and the camera that it is about, if any."""

    message: Message
    camera: str | None = None


class WordOut(Answer):
    """Describes one instruction. ``camera``: the camera that the instruction concerns; null: the subject."""

    code: str
    text: str
    camera: str | None
    message: MessageOut


class LiveOut(Answer):
    """Describes the newest result. ``time``: when the result's pictures were taken, empty before the first result;
    ``age_s``: the pictures' age when the head was ready; ``points`` of ``cameras``: landmarks of the face, as fractions
    of width and height; ``ready``: the head is steady, its eyes are open, and there are no instructions."""

    time: str
    age_s: float
    number: int
    cameras: dict[str, LampsOut]
    head: HeadOut | None
    steady: bool
    words: list[WordOut]
    ready: bool


def word_out(word: Word) -> WordOut:
    """Converts an instruction to its form in an answer."""
    message = MessageOut.model_validate(word.message)
    return WordOut(code=message.code, text=word.message.text, camera=word.camera, message=message)
