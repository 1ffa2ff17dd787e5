"""Measures a camera's picture for the live view."""

from rig.acquisition.image_checks import blur_px, exposure
from rig.image import ImageRgb
from server.storage.records import JsonObject


def measured_frame(name: str, picture: ImageRgb, data: bytes, large: ImageRgb | None) -> JsonObject:
    """Returns a camera's frame: its name, ``data`` (``picture`` as a JPEG file), the picture's ``mean`` (0 to 255) and
    fraction of ``clipped`` pixels. The sharpness (``blur_px``) is measured in ``large``, the picture in full size."""
    level = exposure(picture)
    frame: JsonObject = {
        "name": name,
        "mean": round(level.mean, 1),
        "clipped": round(level.clipped_share, 4),
        "jpeg": data,
    }
    if large is not None:
        blur = blur_px(large)
        frame["blur_px"] = None if blur is None else round(blur, 2)
    return frame
