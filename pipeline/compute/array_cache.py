"""Caches arrays that depend on the head model alone: the first process computes them, and later processes map the file
into memory.

Each file in ``cache_folder()/arrays`` holds the arrays of one computation. The name of such a file is the SHA-256 of
everything on which the arrays depend: the inputs (arrays, settings), the source code, versions, the processor, and the
number of BLAS threads. (Sums depend on this number, and a head must not depend on which process filled the folder.)
Another model, setting or version of the code therefore gets another file, and no file becomes outdated. Files are
written atomically with a checksum, and a damaged file is replaced. If the folder cannot be written, a line in the log
says so, and each process computes the arrays itself. The returned arrays are always read-only."""

import contextlib
import hashlib
import json
import mmap
import os
import sys
import time
import zlib
from collections.abc import Callable, Iterable, Mapping, Sequence
from functools import cache
from pathlib import Path
from typing import Any

import numpy as np
import scipy

from rig.files import cache_folder, write_atomically
from rig.jit import machine, say_not_kept

ALIGNED = 64  # bytes: where arrays begin in a file, and where NumPy begins its own
CHECKSUM = 4  # bytes
BLAS_VARIABLES = ("OPENBLAS_NUM_THREADS", "GOTO_NUM_THREADS", "OMP_NUM_THREADS", "OPENBLAS_CORETYPE")
USED_AFTER_S, UNUSED_S = 86400.0, 30 * 86400.0  # a use is noted once a day; a file that nobody used for a month goes


def cached_arrays(
    name: str,
    inputs: Sequence[Any],
    make: Callable[[], Mapping[str, np.ndarray]],
    *,
    made_by: Iterable[Callable[..., Any]],
) -> dict[str, np.ndarray]:
    """Returns the arrays that ``make()`` computes, from a cache file if an earlier process stored them.

    Args:
        name: a name for the arrays, with which the file's name begins.
        inputs: all inputs of ``make``: arrays, and values whose ``repr`` identifies them.
        make: computes the arrays, of numbers or booleans, by name.
        made_by: functions and classes of other modules on which the result depends; when their source changes, the
            arrays are computed again.

    Returns:
        The arrays by name, in C order and read-only.
    """
    path = cache_folder() / "arrays" / f"{name}-{_digest(inputs, (make, *made_by))}"
    found = _read(path)
    if found is not None:
        return found
    made = {key: np.asarray(array, order="C").view() for key, array in make().items()}
    for array in made.values():
        array.flags.writeable = False
    try:
        write_atomically(path, _packed(made))
        _remove_unused(path.parent)
    except OSError as error:
        say_not_kept(error)
    return made


def _digest(inputs: Sequence[Any], made_by: Iterable[Callable[..., Any]]) -> str:
    threads = [os.environ.get(name) for name in BLAS_VARIABLES]
    environment = (np.__version__, scipy.__version__, machine(), threads, len(os.sched_getaffinity(0)))
    digest = hashlib.sha256(repr(environment).encode())
    for value in inputs:
        if isinstance(value, np.ndarray):
            digest.update(f"{value.dtype.str} {value.shape}".encode())
            digest.update(np.ascontiguousarray(value).data)
        else:
            digest.update(repr(value).encode())
        digest.update(b"\0")
    for source in sorted({_source(each.__module__) for each in made_by}):
        digest.update(source)
    return digest.hexdigest()


@cache
def _source(module: str) -> bytes:
    """Returns the SHA-256 digest of a loaded module's source file."""
    return hashlib.sha256(Path(str(sys.modules[module].__file__)).read_bytes()).digest()


def _packed(arrays: Mapping[str, np.ndarray]) -> bytes:
    """Returns the bytes of a cache file: checksum, length of the header, header, arrays."""
    entries, place = [], 0
    for key, array in arrays.items():
        entries.append((key, array.dtype.str, array.shape, place))
        place += _padded(array.nbytes)
    header = json.dumps(entries).encode()
    start = _padded(CHECKSUM + 8 + len(header))
    data = bytearray(start + place)
    data[CHECKSUM : CHECKSUM + 8] = len(header).to_bytes(8, "little")
    data[CHECKSUM + 8 : CHECKSUM + 8 + len(header)] = header
    for (_, _, _, at), array in zip(entries, arrays.values(), strict=True):
        data[start + at : start + at + array.nbytes] = array.tobytes()
    data[:CHECKSUM] = zlib.crc32(memoryview(data)[CHECKSUM:]).to_bytes(CHECKSUM, "little")
    return bytes(data)


def _read(path: Path) -> dict[str, np.ndarray] | None:
    """Returns the arrays of a cache file, mapped into memory; None if the file is missing or damaged."""
    try:
        with path.open("rb") as stream:
            data = mmap.mmap(stream.fileno(), 0, access=mmap.ACCESS_READ)
    except (OSError, ValueError):  # an empty file cannot be mapped
        return None
    view = memoryview(data)
    if zlib.crc32(view[CHECKSUM:]) != int.from_bytes(view[:CHECKSUM], "little") or len(view) < ALIGNED:
        return None
    length = int.from_bytes(view[CHECKSUM : CHECKSUM + 8], "little")
    start = _padded(CHECKSUM + 8 + length)
    arrays = {}
    for key, dtype, shape, place in json.loads(bytes(view[CHECKSUM + 8 : CHECKSUM + 8 + length])):
        count = int(np.prod(shape, dtype=np.int64))
        arrays[key] = np.frombuffer(data, np.dtype(dtype), count, start + place).reshape(shape)
    with contextlib.suppress(OSError):  # somebody else's file, or a disk that is only read
        if time.time() - path.stat().st_mtime > USED_AFTER_S:
            os.utime(path)
    return arrays


def _remove_unused(folder: Path) -> None:
    for path in folder.iterdir():
        with contextlib.suppress(OSError):  # another process was quicker
            if time.time() - path.stat().st_mtime > UNUSED_S:
                path.unlink()


def _padded(count: int) -> int:
    return -(-count // ALIGNED) * ALIGNED
