"""Writes OpenEXR pictures of linear light in half precision, with lossless compression (ZIP, 16 rows in a block).

The format OpenEXR is described at https://openexr.com/en/latest/OpenEXRFileLayout.html. No library of this project
writes OpenEXR.
"""

import struct
import zlib
from concurrent.futures import ThreadPoolExecutor
from pathlib import Path

import numpy as np
from jaxtyping import Float

from rig.files import write_atomically

MAGIC, VERSION = 20000630, 2
HALF, ZIP = 1, 3  # of a channel's samples; the compression
BLOCK_ROWS = 16
LEVEL = 4  # zlib's usual level takes twice as long for 2 % less
THREADS = 4


def exr_bytes(image: Float[np.ndarray, "h w 3"]) -> bytes:
    """Encodes linear light with sRGB's primaries (Rec. 709) as a picture with the channels B, G and R."""
    height, width = image.shape[:2]
    samples = image.astype("<f2")[:, :, ::-1].transpose(0, 2, 1)  # by row, then by channel in the order of their names
    rows = range(0, height, BLOCK_ROWS)
    with ThreadPoolExecutor(THREADS) as pool:  # zlib works outside the interpreter lock
        blocks = [*pool.map(lambda row: _block(samples[row : row + BLOCK_ROWS]), rows)]
    chunks = [struct.pack("<ii", row, len(data)) + data for row, data in zip(rows, blocks, strict=True)]
    head = _header(width, height)
    starts = len(head) + 8 * len(chunks) + np.cumsum([0, *map(len, chunks[:-1])])
    return b"".join([head, starts.astype("<u8").tobytes(), *chunks])


def write_exr(path: Path, image: Float[np.ndarray, "h w 3"]) -> None:
    """Writes an OpenEXR file atomically. Raises OSError."""
    write_atomically(path, exr_bytes(image))


def _header(width: int, height: int) -> bytes:
    channels = b"".join(name + struct.pack("<iB3xii", HALF, 0, 1, 1) for name in (b"B\0", b"G\0", b"R\0")) + b"\0"
    window = struct.pack("<iiii", 0, 0, width - 1, height - 1)
    attributes = (
        (b"channels", b"chlist", channels),
        (b"compression", b"compression", bytes([ZIP])),
        (b"dataWindow", b"box2i", window),
        (b"displayWindow", b"box2i", window),
        (b"lineOrder", b"lineOrder", b"\0"),
        (b"pixelAspectRatio", b"float", struct.pack("<f", 1.0)),
        (b"screenWindowCenter", b"v2f", struct.pack("<ff", 0.0, 0.0)),
        (b"screenWindowWidth", b"float", struct.pack("<f", 1.0)),
    )
    listed = [name + b"\0" + kind + b"\0" + struct.pack("<i", len(value)) + value for name, kind, value in attributes]
    return struct.pack("<ii", MAGIC, VERSION) + b"".join(listed) + b"\0"


def _block(samples: Float[np.ndarray, "r 3 w"]) -> bytes:
    """Compresses some rows: separates low from high bytes, takes differences of neighbours, and applies zlib. Returns
    the rows' samples uncompressed if that is shorter."""
    raw = np.frombuffer(np.ascontiguousarray(samples).tobytes(), np.uint8)
    parted = np.concatenate([raw[::2], raw[1::2]])
    differences = np.concatenate([parted[:1], parted[1:] - parted[:-1] + np.uint8(128)])
    packed = zlib.compress(differences.tobytes(), LEVEL)
    return packed if len(packed) < len(raw) else raw.tobytes()
