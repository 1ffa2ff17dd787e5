"""Declares the document in which the live view holds one camera's picture and measurements."""

from typing import NotRequired, TypedDict

from rig.messages.message import MessageDocument


class LiveFrame(TypedDict):
    """Holds a camera's picture (None: it delivers none) and what was measured on it: ``mean`` (0 to 255), share of
    ``clipped`` pixels, ``blur_px``."""

    name: str
    jpeg: bytes | None
    mean: NotRequired[float]
    clipped: NotRequired[float]
    blur_px: NotRequired[float | None]
    fault: NotRequired[MessageDocument]
