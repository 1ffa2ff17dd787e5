"""Determines the bit depth of picture files, and detects raw sensor mosaics.

Machine vision software writes 10 or 12 bits into 16-bit files. Without scaling, pictures of 10 or 12 bits in 16-bit
files are nearly black. Machine vision software also writes the sensor's colour filter mosaic as a grey picture, in
which a quarter of the pixels is red and a quarter blue.

The module also fills the empty rims of pictures if their clean plates (pictures of the empty studio) have no rims, and
the reverse. Undistortion leaves an empty rim that is transparent, black or white. In a comparison with a plate without
a rim, a picture's empty rim would seem to be a subject. A picture's filled rim counts as background."""

from collections.abc import Collection, Mapping, Sequence
from concurrent.futures import ThreadPoolExecutor
from dataclasses import dataclass
from pathlib import Path

import cv2
import numpy as np
from jaxtyping import Bool, Float32, Num
from PIL import Image

from rig.image import ImageRgb
from rig.messages.message import Message, compose, some_of

MAX_LEVEL = 4  # of 255 that an empty pixel is from black or white; the rest is JPEG's
MIN_SHARE = 0.002  # of the picture: less is no rim
MAX_SHARE = 0.9  # of the picture: more is one that is dark or burnt out; beside a fisheye's circle lies 0.6 at most
SOFT_PX = 2  # where the edge of a rim is averaged with the picture
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
    """Describes the files of one kind, photographs or clean plates. ``bits`` is the number of used bits in 16-bit
    files, or None for 8-bit files. ``mosaic`` is True for raw sensor mosaics."""

    bits: int | None
    mosaic: bool


def measure_samples(paths: Sequence[Path]) -> Samples:
    """Measures files of one kind. The largest sample in all files determines the number of bits."""
    with ThreadPoolExecutor(max_workers=4) as pool:
        measured = [*pool.map(_measure, paths)]
    largest = [most for most, _ in measured if most is not None]
    mosaics = [is_mosaic for _, is_mosaic in measured]
    mosaic = sum(mosaics) > 0.5 * len(mosaics)
    return Samples(used_bits(max(largest)) if largest else None, mosaic)


def used_bits(largest: int) -> int:
    """Returns the smallest number of bits in ``USED_BITS`` that can represent ``largest``, or else 16."""
    return next((bits for bits in USED_BITS if largest < 2**bits), WHOLE_BITS)


def _measure(path: Path) -> tuple[int | None, bool]:
    """Returns the largest sample of a 16-bit file (None for other files), and whether the file is a mosaic. Returns
    (None, False) for a damaged file."""
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
    """Returns bits per sample and samples per pixel from the header of a PNG or TIFF; 8 and 3 for other formats."""
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
    """Returns whether a grey picture is a sensor mosaic: pixels resemble their second neighbours, which have the same
    colour filter, more than their direct neighbours."""
    values = pixels.astype(np.float32)
    if min(values.shape) < 3:
        return False
    ratios = [_mean_step(values, 1) / max(_mean_step(values, 2), TINY) for values in (values, values.T)]
    return min(ratios) > MOSAIC_RATIO


def _mean_step(values: Float32[np.ndarray, "h w"], apart: int) -> float:
    return float(np.abs(values[apart:] - values[:-apart]).mean())


def fill_rims(
    images: Mapping[str, ImageRgb], plates: Mapping[str, Sequence[ImageRgb]], masked: Collection[str]
) -> tuple[dict[str, ImageRgb], dict[str, tuple[ImageRgb, ...]], list[Message]]:
    """Fills the empty rim of a picture from the first clean plate if the plates have no rim, and the reverse. Ignores
    the plates of cameras in ``masked``."""
    filled, behind = dict(images), {name: tuple(of) for name, of in plates.items()}
    rimmed = []
    for name, image in images.items():
        if name in masked or not behind.get(name):
            continue
        first = behind[name][0]
        filled[name] = _without_rim(image, first)
        behind[name] = tuple(_without_rim(plate, image) for plate in behind[name])
        if filled[name] is not image or behind[name][0] is not first:
            rimmed.append(name)
    return filled, behind, [compose("rims-empty", cameras=some_of(rimmed), count=len(rimmed))] if rimmed else []


def _without_rim(image: ImageRgb, other: ImageRgb) -> ImageRgb:
    """Fills the empty rim of a picture from ``other``. The picture is unchanged unless only it has a rim."""
    rim = empty_rim(image)
    if rim is None or rim.mean() > MAX_SHARE or (rim & ~_empty(other)).mean() < MIN_SHARE:
        return image
    soft = cv2.dilate(rim.view(np.uint8), np.ones((2 * SOFT_PX + 1, 2 * SOFT_PX + 1), np.uint8)).view(bool)
    filled = np.where(soft[..., None], other, image)
    filled.setflags(write=False)
    return filled


def empty_rim(image: ImageRgb) -> Bool[np.ndarray, "h w"] | None:
    """Returns a mask of the black or white pixels that are connected to the border. Returns None if the pixels do not
    touch all four sides, as with dark clothes or overexposed windows."""
    for dark in (True, False):
        sides = (image[:1], image[-1:], image[:, :1], image[:, -1:])
        if not all(_of_value(side, dark=dark).any() for side in sides):
            continue
        empty = _of_value(image, dark=dark)
        _, labels = cv2.connectedComponents(empty.view(np.uint8), connectivity=8)
        at_border = np.unique(np.concatenate([labels[0], labels[-1], labels[:, 0], labels[:, -1]]))
        return empty & np.isin(labels, at_border[at_border > 0])
    return None


def _of_value(image: ImageRgb, *, dark: bool) -> Bool[np.ndarray, "h w"]:
    return image.max(axis=2) <= MAX_LEVEL if dark else image.min(axis=2) >= 255 - MAX_LEVEL


def _empty(image: ImageRgb) -> Bool[np.ndarray, "h w"]:
    return _of_value(image, dark=True) | _of_value(image, dark=False)
