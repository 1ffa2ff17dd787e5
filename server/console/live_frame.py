"""Measures a camera's picture for the live view."""

from typing import NotRequired, TypedDict

from rig.acquisition.image_checks import blur_px, exposure
from rig.image import ImageRgb
from rig.messages.message import MessageDocument


class LiveFrame(TypedDict):
    """Holds a camera's picture as a JPEG file (None: it delivers none) and its measurements: ``mean`` (0 to 255),
    ``clipped`` (fraction of pixels), ``blur_px``."""

    name: str
    jpeg: bytes | None
    mean: NotRequired[float]
    clipped: NotRequired[float]
    blur_px: NotRequired[float | None]
    fault: NotRequired[MessageDocument]


def measured_frame(name: str, picture: ImageRgb, data: bytes, large: ImageRgb | None) -> LiveFrame:
    """Returns a camera's frame: ``data`` is its ``picture`` as a JPEG file; sharpness is measured in ``large``, the
    picture at full size."""
    level = exposure(picture)
    frame: LiveFrame = {
        "name": name,
        "mean": round(level.mean, 1),
        "clipped": round(level.clipped_share, 4),
        "jpeg": data,
    }
    if large is not None:
        blur = blur_px(large)
        frame["blur_px"] = None if blur is None else round(blur, 2)
    return frame
