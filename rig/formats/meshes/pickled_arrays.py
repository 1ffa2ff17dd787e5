"""Reads arrays from untrusted files: npz files within size limits, and pickles without running code.

Loading a pickle normally imports and calls the classes and functions that it names. This module does not import
anything that a pickle names. Objects of NumPy, SciPy and chumpy are replaced by harmless stand-in classes that decode
plain numbers. A pickle with the name of any other object is refused. Pickles of Python 2 are read.
"""

import io
import pickle
import tokenize
import zipfile
import zlib
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import Any

import numpy as np

from rig.errors import InputError
from rig.messages.message import compose

MAX_BYTES = 512 << 20  # FLAME's models have 50 MB, SMPL-X's 550 before compression
MAX_UNPACKED = 2 << 30  # of an npz: four times that
KINDS = ("f2", "f4", "f8", "i1", "i2", "i4", "i8", "u1", "u2", "u4", "u8", "b1")
DAMAGE = (
    ArithmeticError,
    AttributeError,
    EOFError,
    LookupError,
    MemoryError,
    RuntimeError,
    TypeError,
    ValueError,
    pickle.PickleError,
    tokenize.TokenError,
    zipfile.BadZipFile,
    zlib.error,
)


@contextmanager
def open_npz(source: Path | io.BytesIO) -> Iterator[Any]:
    """Opens an npz archive, whose arrays are read on access. Raises OSError or an exception in ``DAMAGE`` for another
    kind of file, and for an archive or array that exceeds ``MAX_UNPACKED`` or its stated size."""
    with np.load(source, allow_pickle=False) as file:
        if sum(entry.file_size for entry in file.zip.infolist()) > MAX_UNPACKED:
            raise ValueError(f"more than {MAX_UNPACKED >> 20} MB of arrays")
        yield file


def read_pickled_arrays(path: Path) -> dict[str, np.ndarray]:
    """Returns the arrays of a pickled dictionary by name. Omits entries without numbers, and converts sparse matrices
    to dense arrays. Raises InputError with the pickle's fault."""
    if path.stat().st_size > MAX_BYTES:
        large = compose("mesh-file-large", size_mb=path.stat().st_size >> 20, most_mb=MAX_BYTES >> 20)
        raise InputError(path.name, [large])
    try:
        with path.open("rb") as file:
            content = _Reader(file, encoding="latin1").load()
        entries = content.items() if isinstance(content, dict) else ()
        arrays = {str(name): array for name, value in entries if (array := _array(value)) is not None}
    except _Foreign as fault:
        raise InputError(path.name, [compose("pickle-name-refused", name=str(fault))]) from None
    except DAMAGE as fault:
        raise InputError(path.name, [compose("file-incomplete", reason=str(fault))]) from None
    if not arrays:
        raise InputError(path.name, [compose("pickle-without-arrays")])
    return arrays


class _Foreign(Exception):
    """Reports that a pickle names a class or function other than array types."""


class _StandIn:
    """Is the base class of the stand-ins for objects in a pickle. A stand-in is never a function, because a pickle can
    set any attribute of an object without ``__setstate__``."""

    def __init__(self, *_: Any) -> None:
        """Ignores the constructor arguments in a pickle."""

    def __setstate__(self, state: Any) -> None:
        """Ignores the state that a pickle sets on an object."""


class _Type(_StandIn):
    """Replaces numpy.dtype. Stores a plain number type and its byte order."""

    def __init__(self, kind: Any = "", *_: Any) -> None:
        self.kind, self.order = str(kind), "<"

    def __setstate__(self, state: tuple[Any, ...]) -> None:
        self.order = ">" if state[1] == ">" else "<"

    def decoded(self) -> np.dtype | None:
        """Returns the NumPy type, or None if the type is not a plain number type."""
        kind = self.kind.lstrip("<>=|")
        return np.dtype(self.order + kind) if kind in KINDS else None


class _Array(_StandIn):
    """Replaces numpy.ndarray. Stores a pickled array's shape, type, memory order and bytes."""

    value: np.ndarray | None = None

    def __setstate__(self, state: tuple[Any, ...]) -> None:
        _, shape, kind, columns_first, raw = state
        self.value = _decoded(raw, kind, shape, "F" if columns_first else "C")


def _decoded(raw: Any, kind: Any, shape: Any, order: Any) -> np.ndarray | None:
    of = kind.decoded() if isinstance(kind, _Type) else None
    if of is None or not isinstance(raw, str | bytes | bytearray):  # bytes(n) of a number would be n zeros
        return None
    data = raw.encode("latin1") if isinstance(raw, str) else bytes(raw)
    sizes = tuple(int(size) for size in shape)
    return np.frombuffer(data, of).reshape(sizes, order="F" if order == "F" else "C")


class _Inert(_StandIn):
    """Replaces an object of SciPy or chumpy. Stores the object's state."""

    state: Any = None
    kind = ""

    def __setstate__(self, state: Any) -> None:
        self.state = state


class _Encoded(_StandIn):
    """Replaces _codecs.encode, by which pickles for Python 2 represent bytes."""

    def __new__(cls, text: str = "", *_: Any) -> Any:
        return text.encode("latin1")


class _FromBuffer(_StandIn):
    """Replaces NumPy's function that creates an array from a buffer."""

    def __new__(cls, raw: Any = b"", kind: Any = None, shape: Any = (), order: Any = "C", *_: Any) -> Any:
        array = _Array()
        array.value = _decoded(raw, kind, shape, order)
        return array


class _Empty(_StandIn):
    """Replaces the function that creates an empty object of a class. It creates only stand-ins."""

    def __new__(cls, kind: Any = None, *_: Any) -> Any:
        return kind() if isinstance(kind, type) and issubclass(kind, _Array | _Inert) else _Inert()


_BY_NAME: dict[tuple[str, str], type[_StandIn]] = {
    ("ndarray", "numpy"): _Array,
    ("dtype", "numpy"): _Type,
    ("_reconstruct", "numpy"): _Empty,
    ("_frombuffer", "numpy"): _FromBuffer,
    ("encode", "_codecs"): _Encoded,
    ("bytes", "__builtin__"): _Encoded,  # of an empty array
    ("_reconstructor", "copy_reg"): _Empty,
    ("_reconstructor", "copyreg"): _Empty,
    ("object", "__builtin__"): _Inert,
    ("object", "builtins"): _Inert,
}
_INERT = ("scipy", "chumpy")


class _Reader(pickle.Unpickler):
    def find_class(self, module: str, name: str) -> type[_StandIn]:
        """Returns the stand-in class for a name in a pickle. Raises _Foreign for all names that have no stand-in."""
        package = module.partition(".")[0]
        if (name, package) in _BY_NAME:
            return _BY_NAME[name, package]
        if package in _INERT:
            return type("_Inert", (_Inert,), {"kind": name})
        raise _Foreign(f"{module}.{name}"[:80])


def _array(value: Any) -> np.ndarray | None:
    """Returns the numbers of an entry as an array, or None for an entry without numbers."""
    if isinstance(value, _Array):
        return value.value
    if not isinstance(value, _Inert) or not isinstance(value.state, dict):
        return None
    state = {str(key): part for key, part in value.state.items()}
    if "indptr" in state:
        return _dense(value.kind, state)
    return _array(state.get("x"))  # of a chumpy array: what it holds


def _dense(kind: str, state: dict[str, Any]) -> np.ndarray | None:
    """Converts a sparse matrix in compressed column or row format to a dense array."""
    data, at, ends = (_array(state.get(name)) for name in ("data", "indices", "indptr"))
    shape = state.get("_shape", state.get("shape"))
    if data is None or at is None or ends is None or shape is None:
        return None
    by_columns = kind.startswith("csc")
    count = int(shape[1] if by_columns else shape[0])
    if len(ends) != count + 1 or int(shape[0]) * int(shape[1]) > MAX_BYTES // 8:
        return None
    out = np.zeros((int(shape[0]), int(shape[1])))
    line = np.repeat(np.arange(count), np.diff(ends))
    np.add.at(out, (at, line) if by_columns else (line, at), data)
    return out
