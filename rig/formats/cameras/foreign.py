"""Holds what all readers of other programs' files share: errors for damaged files, cameras' names, conversion of
lenses."""

import re
import struct
from collections.abc import Callable, Mapping, Sequence
from pathlib import Path
from typing import Any, TypeVar
from xml.etree import ElementTree

import numpy as np

from rig.errors import InputError
from rig.formats.cameras.cameras_json import name_fault
from rig.formats.pictures.picture_names import IMAGE_SUFFIXES, picture_stem
from rig.messages.message import Message, compose
from rig.recorded_lens import COEFFICIENTS, LensModel

T = TypeVar("T")
MATRIX_PLACES = {"fx": (0, 0), "fy": (1, 1), "cx": (0, 2), "cy": (1, 2)}
LENS_LOSS_PX = 0.02  # allowed error of a converted lens: a tenth of a calibration's error
LENS_KEY = re.compile(r"[kpst]\d")  # coefficients of OpenCV's lenses, among other parameters of a camera
METRES_MOST = 30.0  # files with all cameras within 30 units are in metres: no rig is 30 mm wide
BYTES_MOST = 1 << 29  # far above the few megabytes of a rig's sparse model, whose 2D points may be many


class Malformed(ValueError):
    """Reports a fault that one of this project's parsers finds in the bytes of a file."""

    def __init__(self, message: Message) -> None:
        self.message = message
        super().__init__(message)


def parsed(path: Path, parse: Callable[[bytes], T]) -> T:
    """Applies ``parse`` to the bytes of a file. Raises InputError for a damaged file, whatever ``parse`` raises for
    it."""
    try:
        if path.stat().st_size > BYTES_MOST:
            raise InputError(path.name, [compose("file-large", most_mib=BYTES_MOST >> 20)])
        return parse(path.read_bytes())
    except FileNotFoundError as error:
        raise InputError(path.name, [compose("file-absent")]) from error
    except OSError as error:
        raise InputError(path.name, [compose("no-file-read", reason=str(error.strerror or error))]) from error
    except struct.error as error:
        raise InputError(path.name, [compose("record-cut-off")]) from error
    except (ValueError, RecursionError) as error:
        reason = error.message if isinstance(error, Malformed) else str(error)[:400]
        raise InputError(path.name, [compose("file-not-understood", reason=reason)]) from error


def camera_names(files: list[str]) -> list[str]:
    """Returns camera names: the pictures' names without their endings or, where those repeat (``cam00/shot.png``), the
    names of the innermost folders that tell them all apart."""
    paths = [tuple(part for part in file.replace("\\", "/").split("/") if part not in ("", ".")) for file in files]
    stems = [picture_stem(path[-1]) if path else "" for path in paths]
    if len(set(stems)) == len(stems):
        return stems
    for depth in range(2, max(map(len, paths)) + 1):
        folders = [path[-depth] if len(path) >= depth else "" for path in paths]
        if all(folders) and len(set(folders)) == len(folders):
            return folders
    return stems


def lens_entry(
    parameters: Mapping[str, float], where: str, faults: list[Message], *, fisheye: bool = False
) -> dict[str, str | float]:
    """Returns the ``distortion`` entry of ``eigenhead-cameras/1`` for coefficients under OpenCV's names; missing ones
    are 0.

    All foreign lenses get their model here. A coefficient other than 0 that the model does not have is a fault."""
    model: LensModel | None = "kannala-brandt" if fisheye else None
    if model is None and any(parameters.get(key, 0.0) for key in ("k4", "k5", "k6")):
        model = "rational"
    keys = COEFFICIENTS[model] if model else ("k1", "k2", "p1", "p2", "k3")
    lost = [key for key, value in parameters.items() if LENS_KEY.fullmatch(key) and key not in keys and value]
    if lost:
        kind = compose("a-fisheye" if fisheye else "this-lens")
        faults.append(compose("lens-coefficients-lost", camera=where, count=len(lost), lost=lost, lens=kind, held=keys))
    return {"model": model or "brown-conrady", **{key: parameters.get(key, 0.0) for key in keys}}


def number_array(value: Any, shape: tuple[int, ...] | None, where: str, faults: list[Message]) -> np.ndarray:
    """Converts ``value`` to an array. If that fails, a fault is appended and an array of NaN of the wanted shape
    returned, so that the remaining faults are still found."""
    try:
        array = np.array(value, dtype=float)
    except (TypeError, ValueError, OverflowError):
        array = np.zeros(())
    if array.ndim == 0 or (shape is not None and array.shape != shape):
        axes = " x ".join(map(str, shape or ()))
        faults.append(compose("no-list-of", key=where, shape=axes) if axes else compose("no-number-list", key=where))
        return np.full(shape or (3, 3), np.nan)
    return array


def xml_root(data: bytes) -> ElementTree.Element:
    """Returns the root of an XML file. Raises Malformed for a file with declarations, because entities can expand to
    any size."""
    if b"<!DOCTYPE" in data or b"<!ENTITY" in data:
        raise Malformed(compose("xml-declares"))
    try:
        return ElementTree.fromstring(data)
    except ElementTree.ParseError as error:
        raise Malformed(compose("no-xml", reason=str(error))) from None


def sized(folder: Path, name: str, faults: list[Message]) -> tuple[int, int]:
    """Returns width and height of the picture of camera ``name`` in ``folder`` or its ``images``, for formats without
    sizes.

    If there is no picture, a fault is appended that says where to put it, and a placeholder size is returned."""
    from rig.formats.pictures.images import picture_size  # decoders, which most formats do without

    for place in (folder, folder / "images", folder.parent / "images"):
        here = sorted(place.glob(f"{name}.*")) if name_fault(name) is None else []
        inside = sorted(place.glob(f"{name}/*")) if name_fault(name) is None else []  # a camera's own folder
        for path in [*(path for path in here if picture_stem(path.name) == name), *inside]:
            if path.suffix.lower() in IMAGE_SUFFIXES and path.is_file():
                try:
                    return picture_size(path)
                except InputError as error:
                    faults.append(compose("of-file", file=path.name, fault=error.faults[0]))
    faults.append(compose("picture-for-size", camera=name))
    return 1024, 1024


def brown_conrady(
    radial: Sequence[float], radius: float, focal: float, where: str, faults: list[Message]
) -> list[float]:
    """Fits k1 k2 k3 to a radial polynomial k1 k2 k3 k4 ... over the picture; copies them if k4 and higher are zero.

    Args:
        radial: coefficients of the polynomial.
        radius: radius (of ``X / Z``) of the picture's corner.
        focal: focal length, px; the fit may be wrong by ``LENS_LOSS_PX`` at most, otherwise a fault is appended.
    """
    if not any(radial[3:]) or not np.isfinite([*radial, radius, focal]).all():
        return list(radial[:3])
    r2 = np.linspace(0.0, max(radius, 1e-3) ** 2, 400)
    powers = r2[:, None] ** np.arange(1, len(radial) + 1) * np.sqrt(r2)[:, None]
    wanted = powers @ np.array(radial)
    found = np.linalg.lstsq(powers[:, :3], wanted, rcond=None)[0]
    miss_px = focal * np.abs(powers[:, :3] @ found - wanted).max()
    if not miss_px <= LENS_LOSS_PX:
        faults.append(compose("k4-lost", key=f"{where}.k4", miss_px=miss_px))
    return found.tolist()


def corner_radius(size: tuple[int, int], focal: tuple[float, float], centre: tuple[float, float]) -> float:
    """Returns the radius (of ``X / Z``) of the picture's farthest corner from the optical axis."""
    across, down = (max(c, n - c) / f if f > 0 else np.nan for n, f, c in zip(size, focal, centre, strict=True))
    return float(np.hypot(across, down))
