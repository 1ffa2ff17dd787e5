"""What the live view holds of one camera."""

from typing import NotRequired, TypedDict

from rig.messages.message import MessageDocument


class LiveFrame(TypedDict):
    """Holds a camera's picture (None: it shows nothing) and what was measured on it."""

    name: str
    jpeg: bytes | None
    mean: NotRequired[float]
    clipped: NotRequired[float]
    blur_px: NotRequired[float | None]
    fault: NotRequired[MessageDocument]
