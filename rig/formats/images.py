"""Picture files: read by their content, written so that no reader meets half of one."""

import hashlib
from io import BytesIO
from pathlib import Path

import cv2
import numpy as np
from jaxtyping import UInt8
from PIL import Image, UnidentifiedImageError

from rig.atomic_write import write_atomically
from rig.capture import ImageRgb
from rig.errors import InputError

IMAGE_FORMATS = ("PNG", "JPEG", "TIFF", "WEBP")  # JPEG covers the MPO that many phones write into a .jpg


PIXELS_MOST = 100_000_000  # 100 Mpx, the largest studio backs; more is a decompression bomb


# Sensor noise has no repeats to search for: one filter and run lengths take half the time and a sixth less space.
PNG_OPTIONS = [
    *(cv2.IMWRITE_PNG_COMPRESSION, 1),
    *(cv2.IMWRITE_PNG_FILTER, cv2.IMWRITE_PNG_FILTER_AVG),
    *(cv2.IMWRITE_PNG_STRATEGY, cv2.IMWRITE_PNG_STRATEGY_RLE),
]


def write_image(path: Path, image: UInt8[np.ndarray, "h w 3"] | UInt8[np.ndarray, "h w"], quality: int = 95) -> None:
    """Writes RGB or grey pixels as the format of the suffix."""
    image = np.ascontiguousarray(image)
    pixels = cv2.cvtColor(image, cv2.COLOR_RGB2BGR) if image.ndim == 3 else image
    options = [cv2.IMWRITE_JPEG_QUALITY, quality] if path.suffix == ".jpg" else PNG_OPTIONS
    done, data = cv2.imencode(path.suffix, pixels, options)
    assert done
    write_atomically(path, data.tobytes())


def read_image(path: Path) -> ImageRgb:
    """An RGB image. Raises InputError."""
    pixels, _, fault = decode_image_file(path, path.name, grey=False)
    if pixels is None:
        raise InputError(path.name, [fault])
    return pixels


def decode_image_file(path: Path, where: str, *, grey: bool) -> tuple[np.ndarray | None, str, str]:
    data = path.read_bytes()
    try:
        with Image.open(BytesIO(data), formats=IMAGE_FORMATS) as header:  # reads the header only
            width, height = header.size
    except (UnidentifiedImageError, OSError, ValueError, SyntaxError, Image.DecompressionBombError):
        return None, "", f"{where} is damaged or no PNG, JPEG, TIFF or WebP image"
    if width * height > PIXELS_MOST:
        return None, "", f"{where} is {width} x {height} pixels; at most {PIXELS_MOST:,} are read"
    flags = cv2.IMREAD_GRAYSCALE if grey else cv2.IMREAD_COLOR_RGB
    # The calibration holds for the sensor's own rows and columns, whatever an EXIF flag says of the picture.
    try:
        pixels = cv2.imdecode(np.frombuffer(data, np.uint8), flags | cv2.IMREAD_IGNORE_ORIENTATION)
    except cv2.error:
        pixels = None
    if pixels is None or (path.suffix.lower() == ".png" and b"IEND" not in data[-16:]):
        return None, "", f"{where} is damaged: its pixels cannot be decoded"
    return pixels, hashlib.sha256(data).hexdigest(), ""
