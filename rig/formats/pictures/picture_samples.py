"""Finds how the samples of picture files are stored, before anything is measured in the pictures.

Machine vision software writes 10 or 12 bits into files of 16 bits: read as they are, such pictures are nearly black. It
also writes the sensor's mosaic, a quarter of whose pixels is red and a quarter blue, as a grey picture.

Enters: files of one kind (photographs or clean plates) of all cameras. Leaves: how many bits they use, and whether they
are mosaics."""

from collections.abc import Sequence
from concurrent.futures import ThreadPoolExecutor
from dataclasses import dataclass
from pathlib import Path

import cv2
import numpy as np
from jaxtyping import Float32, Num
from PIL import Image

WHOLE_BITS = 16
USED_BITS = (8, 10, 12, 14)  # numbers of bits that occur in files of 16 bits
BITS_PER_SAMPLE, SAMPLES_PER_PIXEL = 258, 277  # TIFF's tags
MOSAIC_RATIO = 1.35  # difference of neighbours over that of second neighbours: 1.9 in mosaics of a grey backdrop, 6 and
# more of a face; 0.6 to 1.0 in grey pictures, 1.0 in noise alone
TINY = 1e-6  # levels: a picture of one value is no mosaic
HEADER_BYTES = 32
PNG = b"\x89PNG\r\n\x1a\n"
TIFF = (b"II*\x00", b"MM\x00*")


@dataclass(frozen=True, slots=True)
class Samples:
    """Describes how the files of one kind are stored. ``bits``: how many of 16 bits are used, None for files of 8 bits;
    ``mosaic``: whether they hold a sensor's mosaic."""

    bits: int | None
    mosaic: bool


def measure_samples(paths: Sequence[Path]) -> Samples:
    """Measures the samples of files of one kind. The largest sample of all files determines the number of bits."""
    with ThreadPoolExecutor(max_workers=4) as pool:
        measured = [*pool.map(_measure, paths)]
    largest = [most for most, _ in measured if most is not None]
    mosaics = [is_mosaic for _, is_mosaic in measured]
    mosaic = sum(mosaics) > 0.5 * len(mosaics)
    return Samples(used_bits(max(largest)) if largest else None, mosaic)


def used_bits(largest: int) -> int:
    """Returns the smallest number of bits in ``USED_BITS`` that holds ``largest``, or 16 if no such number does."""
    return next((bits for bits in USED_BITS if largest < 2**bits), WHOLE_BITS)


def _measure(path: Path) -> tuple[int | None, bool]:
    """Returns the largest sample of a 16-bit file (otherwise None), and whether it is a mosaic; (None, False) for
    damaged files."""
    try:
        depth, channels = _depth_and_channels(path)
        if depth != WHOLE_BITS and channels != 1:
            return None, False
        data = path.read_bytes()
        pixels = cv2.imdecode(np.frombuffer(data, np.uint8), cv2.IMREAD_UNCHANGED | cv2.IMREAD_IGNORE_ORIENTATION)
    except (OSError, ValueError, SyntaxError, cv2.error):
        return None, False
    if pixels is None:
        return None, False
    most = int(pixels.max()) if pixels.dtype == np.uint16 else None
    return most, pixels.ndim == 2 and is_mosaic(pixels)


def _depth_and_channels(path: Path) -> tuple[int, int]:
    """Returns bits per sample and samples per pixel from the header of a PNG or TIFF file; 8 and 3 for other
    formats."""
    with path.open("rb") as file:
        data = file.read(HEADER_BYTES)
    if data.startswith(PNG) and len(data) > 25:
        return data[24], 1 if data[25] == 0 else 3
    if data.startswith(TIFF):
        with Image.open(path, formats=("TIFF",)) as header:
            tags = getattr(header, "tag_v2", {})
            bits = tags.get(BITS_PER_SAMPLE, (8,))
            return int(np.max(bits)), int(tags.get(SAMPLES_PER_PIXEL, 1))
    return 8, 3


def is_mosaic(pixels: Num[np.ndarray, "h w"]) -> bool:
    """Tells whether a grey picture is a sensor's mosaic: its pixels resemble their second neighbours, which have the
    same colour filter, more than their neighbours."""
    values = pixels.astype(np.float32)
    if min(values.shape) < 3:
        return False
    ratios = [_mean_step(values, 1) / max(_mean_step(values, 2), TINY) for values in (values, values.T)]
    return min(ratios) > MOSAIC_RATIO


def _mean_step(values: Float32[np.ndarray, "h w"], apart: int) -> float:
    return float(np.abs(values[apart:] - values[:-apart]).mean())
