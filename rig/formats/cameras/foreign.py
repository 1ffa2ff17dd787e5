"""Provides functions that all readers of other programs' camera files use. The module's functions report damaged files,
name cameras, convert lenses and poses, and collect faults. The module also recognises camera files that no reader
supports. If a capture has no readable cameras, the program estimates the cameras from the photographs, and a message
names the unread camera files."""

import csv
import re
import struct
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, field
from fnmatch import fnmatch
from pathlib import Path
from types import MappingProxyType
from typing import Any, TypeVar
from xml.etree import ElementTree

import numpy as np
from jaxtyping import Float

from rig.errors import InputError
from rig.formats.cameras.cameras_json import FORMAT, rig_from_document
from rig.formats.cameras.foreign_keys import ForeignKey, Table, says_nothing
from rig.formats.pictures.picture_names import IMAGE_SUFFIXES, entry, picture_stem, safe_name
from rig.geometry import rotation_from_vector
from rig.messages.message import Message, compose, say_once, some_of
from rig.recorded_lens import COEFFICIENTS, LensModel
from rig.rig import Rig
from rig.text import as_utf8

VALUE_MOST = 40  # characters of a value in a message
HEAD_BYTES = 1 << 16  # the words by which an XMP file is recognised stand near its beginning
PATTERNS = (
    ("transforms_*.json", "transforms.json in parts: join their frames in one transforms.json"),
    ("poses_bounds.npy", "LLFF"),
    ("cameras*.npz", "NeuS, IDR"),
    ("*.sfm", "Meshroom"),
    ("sfm_data*.json", "OpenMVG"),
    ("bundle*.out", "Bundler"),
    ("*.nvm", "VisualSFM"),
    ("*calibrated_camera_parameters*.txt", "Pix4D"),
    ("database.db", "COLMAP without a model: export it to sparse/0"),
    ("*.ps[xz]", "Metashape: export its cameras as XML"),
    ("*.r[cs]proj", "RealityCapture: export its cameras as XMP or CSV"),
    ("*.fbx", "FBX: export COLMAP's model or transforms.json"),
    ("*.abc", "Alembic: export COLMAP's model or transforms.json"),
    ("*.mat", "MATLAB: write OpenCV's YAML"),
    ("*.p4[dm]", "Pix4D: export its calibrated cameras as OpenCV's YAML"),
    ("*.qca.txt", "Qualisys: write cameras.json"),
    ("*.xcp", "Vicon: write cameras.json"),
    ("*_cam.txt", "MVSNet: export COLMAP's model"),
    ("*.usd[ac]", "USD: export COLMAP's model or transforms.json"),
    ("*.opk", "positions and omega, phi, kappa without lenses: export Metashape's XML"),
    ("*.chan", "Nuke's camera over time: export one camera a file of a program that is read"),
)  # fmt: skip
OPENCV_KEYS = ("camera_matrix", "cameraMatrix", "Camera_Matrix", "\nK1:", "\nM1:")
OPENCV = "OpenCV's calibration of one camera or a pair: write K_<name>, dist_<name>, R_<name> and T_<name> of all"
CONTENTS = (  # endings, words of which a file holds one, and its program
    ((".yaml", ".yml"), ("T_cn_cnm1", "distortion_model:"), "Kalibr: write its chain as OpenCV's YAML or cameras.json"),
    ((".yaml", ".yml", ".xml"), OPENCV_KEYS, OPENCV),
    ((".xml",), ("<BlocksExchange",), "ContextCapture's BlocksExchange: export Metashape's XML or COLMAP's model"),
    ((".json",), ('"Calibration"', '"libCalib'), "calib.io: export OpenCV's YAML"),
    ((".json",), ('"intrinsic_matrix"',), "Open3D: write one transforms.json of all cameras"),
    ((".json",), ('"sfm_data_version"',), "OpenMVG: export COLMAP's model"),
    ((".json",), ('"camera_poses"',), "MultiCal: write OpenCV's YAML"),
    ((".json",), ('"distCoef"',), "Panoptic Studio: write OpenCV's YAML"),
    ((".json",), ('"projection_type"',), "OpenSfM: export COLMAP's model"),
)  # fmt: skip
T = TypeVar("T")
LENS_LOSS_PX = 0.02  # allowed error of a converted lens: a tenth of a calibration's error
UTF16_DECLARED = re.compile(rb"(?i)^(\s*<\?xml[^>]*?)encoding=[\"']utf-(?:16|32)[^\"']*[\"']")
SKEW_LEAST = 1e-6  # in focal lengths; far below a visible error, above the rounding of files
LENS_KEY = re.compile(r"[kpst]\d")  # coefficients of OpenCV's lenses, among other parameters of a camera
METRES_MOST = 30.0  # files with all cameras within 30 units of each other are in metres: no rig is 30 mm wide
BYTES_MOST = 1 << 29  # far above the few megabytes of a rig's sparse model, whose 2D points may be many


@dataclass(frozen=True, slots=True)
class CamerasRead:
    """Holds the rig from a file, warnings, and the reasons for which cameras were excluded."""

    rig: Rig
    remarks: tuple[Message, ...] = ()
    left_out: Mapping[str, Message] = field(default_factory=dict)


@dataclass(slots=True)
class Reading:
    """Collects faults, warnings and excluded cameras while the file ``subject`` is read."""

    subject: str
    faults: list[Message] = field(default_factory=list)
    left_out: dict[str, Message] = field(default_factory=dict)
    _meant: dict[tuple[str, ForeignKey], list[tuple[str, object]]] = field(default_factory=dict)
    _unknown: dict[str, None] = field(default_factory=dict)

    def judge(self, table: Table, values: Mapping[str, object], whose: str, *, place: str = "") -> None:
        """Records the keys of ``values`` that ``table`` refuses, reports or does not contain.

        ``whose`` is the camera's name, or an empty text for keys of the whole file. ``place`` is the prefix of the keys
        in the table."""
        for key, value in values.items():
            rule = table.get(place + key)
            if rule is None:
                self._unknown[place + key] = None
            elif rule.treatment in ("refused", "told") and value is not None and not says_nothing(value, rule):
                self._meant.setdefault((place + key, rule), []).append((whose, value))

    def leave_out(self, name: str, why: Message) -> None:
        """Records that a camera is excluded, and why."""
        self.left_out[name] = why

    def finish(self, entries: Sequence[Mapping[str, object]]) -> CamerasRead:
        """Builds the rig from ``eigenhead-cameras/1`` entries, and returns it with all recorded warnings. Raises
        InputError naming every fault."""
        warnings: list[Message] = []
        for (key, rule), cases in self._meant.items():
            whose, value = _whose([name for name, _ in cases], key), shown(cases[0][1])
            sentence = compose("key-is", whose=whose, value=value, why=rule.why)
            if rule.treatment == "refused":
                self.faults.append(sentence)
            else:
                warnings.append(
                    compose("unknown-key", remark=compose("key-not-used", file=self.subject, told=sentence))
                )
        if self._unknown:
            keys = some_of([shown(key) for key in self._unknown])
            remark = compose("keys-unknown", file=self.subject, count=len(self._unknown), keys=keys)
            warnings.append(compose("unknown-key", remark=remark))
        warnings += [compose("view-left-out", remark=sentence) for sentence in self._left_out()]
        names = [str(entry.get("name")) for entry in entries]
        try:
            rig = rig_from_document({"format": FORMAT, "unit": "mm", "cameras": list(entries)}, self.subject)
        except InputError as error:
            faults = [*self.faults, *error.faults]
            raise InputError(self.subject, [*say_once(faults, names), *self._left_out()]) from None
        if self.faults:
            raise InputError(self.subject, say_once(self.faults, names))
        return CamerasRead(rig, tuple(warnings), MappingProxyType(dict(self.left_out)))

    def _left_out(self) -> list[Message]:
        reasons: dict[Message, list[str]] = {}
        for name, why in self.left_out.items():
            reasons.setdefault(why, []).append(name)
        return [
            compose("cameras-left-out", cameras=some_of(names), why=why, file=self.subject)
            for why, names in reasons.items()
        ]


def shown(value: object, most: int = VALUE_MOST) -> str:
    """Returns the ``repr`` of a value, shortened to ``most`` characters."""
    if isinstance(value, str):
        return repr(value if len(value) <= most else value[: most - 3] + "...")
    text = repr(value)
    return text if len(text) <= most else text[: most - 3] + "..."


def _whose(names: Sequence[str], key: str) -> str | Message:
    """Returns a text with a key and the names of the cameras that have the key."""
    cameras = [name for name in names if name]
    if len(cameras) == 1:
        return key.replace("<name>", cameras[0]) if "<name>" in key else f"{cameras[0]}.{key}"
    return compose("key-of-cameras", cameras=len(cameras), names=some_of(cameras), key=key) if cameras else key


class Malformed(ValueError):
    """Reports a fault that a parser of this project finds in the bytes of a file."""

    def __init__(self, message: Message) -> None:
        self.message = message
        super().__init__(message)


def parsed(path: Path, parse: Callable[[bytes], T]) -> T:
    """Applies ``parse`` to the bytes of a file. Converts exceptions due to damaged files to InputError."""
    try:
        if path.stat().st_size > BYTES_MOST:
            raise InputError(path.name, [compose("file-large", most_mib=BYTES_MOST >> 20)])
        return parse(as_utf8(path.read_bytes()))
    except FileNotFoundError as error:
        raise InputError(path.name, [compose("file-absent")]) from error
    except OSError as error:
        raise InputError(path.name, [compose("no-file-read", reason=str(error.strerror or error))]) from error
    except struct.error as error:
        raise InputError(path.name, [compose("record-cut-off")]) from error
    except (ValueError, RecursionError, csv.Error) as error:
        reason = error.message if isinstance(error, Malformed) else str(error)[:400]
        raise InputError(path.name, [compose("file-not-understood", reason=reason)]) from error


def camera_names(files: list[str]) -> list[str]:
    """Returns camera names from the paths of pictures: the file names without suffix. If pictures' file names repeat
    (``cam00/shot.png``), cameras get the names of the innermost folders that differ for all pictures."""
    paths = [tuple(part for part in file.replace("\\", "/").split("/") if part not in ("", ".")) for file in files]
    stems = [picture_stem(path[-1]) if path else "" for path in paths]
    if len(set(stems)) == len(stems):
        return stems
    for depth in range(2, max(map(len, paths)) + 1):
        folders = [path[-depth] if len(path) >= depth else "" for path in paths]
        if all(folders) and len(set(folders)) == len(folders):
            return folders
    return stems


def camera_entry(
    name: str,
    size: Sequence[float | None],
    intrinsics: Sequence[float],
    lens: Mapping[str, str | float],
    rotation: Float[np.ndarray, "3 3"],
    translation: Float[np.ndarray, " 3"],
) -> dict[str, object]:
    """Returns a camera's entry of ``eigenhead-cameras/1``. ``size`` is width and height (px), ``intrinsics`` fx fy cx
    cy (px), ``lens`` a result of ``lens_entry``. The pose (mm) is camera_from_world."""
    return {
        "name": name,
        "width": size[0],
        "height": size[1],
        "intrinsics": dict(zip(("fx", "fy", "cx", "cy"), map(float, intrinsics), strict=True)),
        "distortion": lens,
        "camera_from_world": {"rotation": rotation.tolist(), "translation": translation.tolist()},
    }


def matrix_intrinsics(matrix: Float[np.ndarray, "3 3"]) -> list[float]:
    """Returns fx, fy, cx and cy of a camera matrix."""
    return matrix[[0, 1, 0, 1], [0, 1, 2, 2]].tolist()


def pose_rotation(value: Float[np.ndarray, "..."]) -> Float[np.ndarray, "..."]:
    """Converts a rotation vector to a matrix. Returns an array of another size than 3 unchanged."""
    if value.size != 3:
        return value
    return rotation_from_vector(value.ravel()) if np.isfinite(value).all() else np.full((3, 3), np.nan)


def lens_entry(
    parameters: Mapping[str, float], where: str, faults: list[Message], *, fisheye: bool = False, skew: float = 0.0
) -> dict[str, str | float]:
    """Returns the ``distortion`` entry of ``eigenhead-cameras/1`` for coefficients with OpenCV's names. A missing lens
    coefficient is 0. ``skew`` is entry (0, 1) of the camera matrix divided by fx.

    The coefficients determine the lens model. A nonzero coefficient that the lens model lacks is a fault."""
    model: LensModel | None = "kannala-brandt" if fisheye else None
    if model is None and any(parameters.get(key, 0.0) for key in ("k4", "k5", "k6")):
        model = "rational"
    keys = COEFFICIENTS[model] if model else ("k1", "k2", "p1", "p2", "k3")
    lost = [key for key, value in parameters.items() if LENS_KEY.fullmatch(key) and key not in keys and value]
    if lost:
        kind = compose("a-fisheye" if fisheye else "this-lens")
        faults.append(compose("lens-coefficients-lost", camera=where, count=len(lost), lost=lost, lens=kind, held=keys))
    found = {"model": model or "brown-conrady", **{key: parameters.get(key, 0.0) for key in keys}}
    return found | {"skew": skew} if np.isfinite(skew) and abs(skew) > SKEW_LEAST else found


def number_array(value: Any, shape: tuple[int, ...] | None, where: str, faults: list[Message]) -> np.ndarray:
    """Converts ``value`` to an array. If ``value`` has another form, appends a fault and returns NaN in the wanted
    shape, so that the reader can find further faults."""
    try:
        array = np.array(value, dtype=float)
    except (TypeError, ValueError, OverflowError):
        array = np.zeros(())
    if array.ndim == 0 or (shape is not None and array.shape != shape):
        axes = " x ".join(map(str, shape or ()))
        faults.append(compose("no-list-of", key=where, shape=axes) if axes else compose("no-number-list", key=where))
        return np.full(shape or (3, 3), np.nan)
    return array


def word_numbers(text: str | None, count: int, where: str, faults: list[Message]) -> Float[np.ndarray, " n"]:
    """Converts the words of a text to numbers. Appends a fault and returns NaN if that fails."""
    try:
        values = np.array([float(word) for word in (text or "").split()])
    except ValueError:
        values = np.zeros(0)
    if len(values) != count:
        faults.append(compose("no-numbers", key=where, count=count))
        return np.full(count, np.nan)
    return values


def pose_matrix(value: Any, where: str, faults: list[Message]) -> Float[np.ndarray, "3 4"]:
    """Converts a 4 x 4 or 3 x 4 pose to its first three rows. Appends a fault and returns NaN if that fails."""
    rows = 3 if isinstance(value, list) and len(value) == 3 else 4
    return number_array(value, (rows, 4), where, faults)[:3]


def matrix_skew(matrix: Float[np.ndarray, "3 3"]) -> float:
    """Returns entry (0, 1) of a camera matrix divided by fx."""
    return float(matrix[0, 1] / matrix[0, 0]) if matrix.shape == (3, 3) and matrix[0, 0] else 0.0


def millimetres_of(centres: Sequence[Float[np.ndarray, " 3"]]) -> float:
    """Returns 1000 if the cameras' positions seem to be in metres, and 1 if they seem to be in millimetres."""
    known = [centre for centre in centres if np.isfinite(centre).all()]
    return 1000.0 if known and np.ptp(known, axis=0).max() < METRES_MOST else 1.0


def xml_root(data: bytes) -> ElementTree.Element:
    """Returns the root of an XML file. Raises Malformed for a DOCTYPE or entities, which can expand to any size."""
    if b"<!DOCTYPE" in data or b"<!ENTITY" in data:
        raise Malformed(compose("xml-declares"))
    try:
        return ElementTree.fromstring(UTF16_DECLARED.sub(rb"\1", data))  # a text in UTF-16 came as UTF-8
    except ElementTree.ParseError as error:
        raise Malformed(compose("no-xml", reason=str(error))) from None


def sized(folder: Path, name: str, faults: list[Message]) -> tuple[int, int]:
    """Returns width and height (px) of the picture of camera ``name`` in ``folder`` or ``folder/images``, for file
    formats that do not state sizes.

    If the camera has no picture, appends to ``faults`` where to put one, and returns a placeholder size."""
    from rig.formats.pictures.images import picture_size  # decoders, which most formats do without

    for place in (folder, entry(folder, "images"), entry(folder.parent, "images")):
        here = sorted(place.iterdir()) if place.is_dir() else []
        known = {safe_name(name), name}
        inside = [path for inner in here if inner.is_dir() and inner.name in known for path in sorted(inner.iterdir())]
        for path in [*(path for path in here if picture_stem(path.name) in known), *inside]:
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
    """Approximates the polynomial ``radial`` with coefficients k1 k2 k3 k4 ... by three coefficients k1 k2 k3.
    ``radius`` is the radius of the picture's corner, in units of ``X / Z``. Appends a fault if the error exceeds
    ``LENS_LOSS_PX`` at the focal length ``focal`` (px)."""
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
    """Returns the radius, in units of ``X / Z``, of the picture's corner that is farthest from the optical axis."""
    across, down = (max(c, n - c) / f if f > 0 else np.nan for n, f, c in zip(size, focal, centre, strict=True))
    return float(np.hypot(across, down))


def unread_programs(folder: Path) -> list[Message]:
    """Returns a message for each unsupported program that lists its camera files in ``folder``."""
    files: dict[str, list[str]] = {}
    for path in sorted(folder.iterdir()):
        if path.is_file() and (program := program_of(path)):
            files.setdefault(program, []).append(path.name)
    return [compose("cameras-of-program", files=some_of(names), program=program) for program, names in files.items()]


def program_of(path: Path) -> str | None:
    """Returns the program that wrote an unsupported camera file, and a remedy, or None for any other file."""
    named = (program for pattern, program in PATTERNS if fnmatch(path.name.lower(), pattern))
    held = (
        program
        for endings, words, program in CONTENTS
        if path.suffix.lower() in endings and any(word in head_of(path) for word in words)
    )
    return next(named, None) or next(held, None)


def head_of(path: Path) -> str:
    """Returns the beginning of a text file, which identifies its format, or an empty text for an unreadable file."""
    try:
        with path.open("rb") as file:
            return as_utf8(file.read(HEAD_BYTES)).decode("utf-8", "replace")
    except (OSError, ValueError):
        return ""
