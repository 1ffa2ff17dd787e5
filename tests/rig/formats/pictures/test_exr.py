"""OpenEXR pictures hold what was written; the OpenEXR library reads them, too (3.5, tried by hand)."""

import struct
import zlib
from pathlib import Path

import numpy as np
import pytest

from rig.formats.pictures.exr import write_exr


def read_exr(data: bytes) -> np.ndarray:
    """The picture of a scan-line file with ZIP compression and half channels B, G and R, step by step as the
    format's description has it."""
    assert struct.unpack_from("<ii", data) == (20000630, 2)
    at, attributes = 8, {}
    while data[at]:
        name, kind = data[at:].split(b"\0", 2)[:2]
        at += len(name) + len(kind) + 2
        (size,) = struct.unpack_from("<i", data, at)
        attributes[name.decode()] = data[at + 4 : at + 4 + size]
        at += 4 + size
    left, top, right, bottom = struct.unpack("<iiii", attributes["dataWindow"])
    assert (left, top) == (0, 0)
    assert attributes["compression"] == b"\3"
    width, height = right + 1, bottom + 1
    blocks = -(-height // 16)
    starts = struct.unpack_from(f"<{blocks}Q", data, at + 1)
    image = np.zeros((height, width, 3), np.float16)
    for start in starts:
        row, size = struct.unpack_from("<ii", data, start)
        rows = min(16, height - row)
        raw, whole = data[start + 8 : start + 8 + size], rows * width * 6
        if size < whole:
            steps = np.frombuffer(zlib.decompress(raw), np.uint8).astype(int)
            parted = np.cumsum(np.concatenate([steps[:1], steps[1:] - 128])).astype(np.uint8)
            joined = np.empty(whole, np.uint8)
            joined[::2], joined[1::2] = parted[: (whole + 1) // 2], parted[(whole + 1) // 2 :]
            raw = joined.tobytes()
        samples = np.frombuffer(raw, "<f2").reshape(rows, 3, width)
        image[row : row + rows] = samples.transpose(0, 2, 1)[:, :, ::-1]
    return image


@pytest.mark.parametrize("shape", [(1, 1, 3), (37, 53, 3), (64, 48, 3)])
def test_a_picture_is_read_back(shape: tuple[int, int, int], tmp_path: Path) -> None:
    smooth = np.linspace(0.0, 2.0, int(np.prod(shape)), dtype=np.float32).reshape(shape)
    for image in (smooth, np.random.default_rng(1).random(shape, np.float32)):  # noise is stored as it is
        write_exr(tmp_path / "light.exr", image)
        np.testing.assert_array_equal(read_exr((tmp_path / "light.exr").read_bytes()), image.astype(np.float16))
    write_exr(tmp_path / "even.exr", np.full((128, 128, 3), 0.25, np.float32))
    assert (tmp_path / "even.exr").stat().st_size < 128 * 128 * 6 / 20
