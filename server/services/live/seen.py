"""Holds what one look at the cameras finds. These values travel from the child process to the service."""

from collections.abc import Mapping
from dataclasses import dataclass

from rig.messages.message import Message

Numbers = tuple[float, ...]


@dataclass(frozen=True, slots=True)
class CameraSeen:
    """Holds what one camera shows.

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


@dataclass(frozen=True, slots=True)
class HeadSeen:
    """Holds the head at one moment.

    Attributes:
        rotation: of world_from_head, row by row; ``translation``: mm; ``scale``: of the model's mean size.
        left_deg: how far the face looks to the subject's left, seen from the front camera; ``up_deg``: the same
            upwards.
        right_mm: how far the head is to the front picture's right of the place where the cameras look; ``down_mm`` and
            ``away_mm`` the same downwards, and away from the front camera; ``room_mm`` how far it may be to a side,
            ``depth_mm`` along the view.
        openings: of the lids, by side (``pipeline.faces.eyes``); ``eyes_open``: both are; None where they are not seen.
        vertices: of the small mesh about the head's middle, as the front camera sees it: right, down, away (mm).
        triangles: of these vertices.
    """

    rotation: Numbers
    translation: Numbers
    scale: float
    left_deg: float
    up_deg: float
    right_mm: float
    down_mm: float
    away_mm: float
    room_mm: float
    depth_mm: float
    openings: Mapping[str, float]
    eyes_open: bool | None
    vertices: tuple[Numbers, ...] = ()
    triangles: tuple[tuple[int, ...], ...] = ()


@dataclass(frozen=True, slots=True)
class Seen:
    """Holds what one look finds. ``faces``: whether some camera shows a face, although no head follows from them;
    ``calibrated``: whether the cameras' places are known; ``missing``: cameras that deliver no picture."""

    cameras: Mapping[str, CameraSeen]
    head: HeadSeen | None
    faces: bool
    calibrated: bool
    missing: tuple[str, ...] = ()


@dataclass(frozen=True, slots=True)
class Lamps:
    """Holds whether a camera shows the face, is sharp, well exposed and centred, and is looked at by the face; None
    where that is not known or does not matter."""

    face: bool | None = None
    sharp: bool | None = None
    exposed: bool | None = None
    centred: bool | None = None
    looking: bool | None = None
    points: tuple[Numbers, ...] = ()


@dataclass(frozen=True, slots=True)
class Word:
    """Holds one thing to do, and the camera that it is about, if it is about one."""

    message: Message
    camera: str | None = None


@dataclass(frozen=True, slots=True)
class LiveShown:
    """Holds the newest look: when its pictures were taken (UTC, ISO 8601), how old they were when the head was ready,
    lamps by camera, the head, and what to do.

    ``ready``: the head is steady, its eyes are open and nothing is to do.
    """

    time: str
    age_s: float
    number: int
    cameras: Mapping[str, Lamps]
    head: HeadSeen | None
    steady: bool
    words: tuple[Word, ...]
    ready: bool
