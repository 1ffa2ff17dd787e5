"""What all readers of other programs' files share: damage becomes an InputError, and what was read is judged as the
``eigenhead-cameras/1`` document would be."""

import struct
from collections.abc import Callable, Mapping, Sequence
from pathlib import Path
from typing import Any, TypeVar

import numpy as np

from rig.errors import InputError
from rig.formats.cameras_json import FORMAT, rig_from_document
from rig.rig import Rig

T = TypeVar("T")
BYTES_MOST = 1 << 29  # a sparse model of a rig is a few megabytes; its 2D points may be many


def parsed(path: Path, parse: Callable[[bytes], T]) -> T:
    """``parse`` of the file's bytes, with whatever damage it meets reported as InputError."""
    try:
        if path.stat().st_size > BYTES_MOST:
            raise InputError(path.name, [f"is larger than {BYTES_MOST >> 20} MiB"])
        return parse(path.read_bytes())
    except OSError as error:
        raise InputError(path.name, [f"cannot be read ({error.strerror or error})"]) from error
    except struct.error as error:
        raise InputError(path.name, ["ends in the middle of a record: it is truncated or no COLMAP file"]) from error
    except (ValueError, RecursionError) as error:
        raise InputError(path.name, [f"cannot be understood ({str(error)[:200]})"]) from error


def judged_rig(entries: Sequence[Mapping[str, object]], subject: str, faults: list[str]) -> Rig:
    """The rig of ``entries``. Raises InputError naming ``faults`` and those that ``rig_from_document`` finds."""
    try:
        rig = rig_from_document({"format": FORMAT, "unit": "mm", "cameras": entries}, subject)
    except InputError as error:
        raise InputError(subject, [*faults, *error.faults]) from None
    if faults:
        raise InputError(subject, faults)
    return rig


def number_array(value: Any, shape: tuple[int, ...] | None, where: str, faults: list[str]) -> np.ndarray:
    """``value`` as an array; on a fault, one of NaN of the wanted shape, so that the other faults are still found."""
    try:
        array = np.array(value, dtype=float)
    except (TypeError, ValueError, OverflowError):
        array = np.zeros(())
    if array.ndim == 0 or (shape is not None and array.shape != shape):
        faults.append(f"{where} is missing or no list of {' x '.join(map(str, shape)) + ' ' if shape else ''}numbers")
        return np.full(shape or (3, 3), np.nan)
    return array
