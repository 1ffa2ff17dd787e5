"""Turns a folder of photographs, with or without scale.json, into a capture: its cameras are estimated and stored.

Each step writes its result to the folder ``kept``: cameras.json, calibration.json (figures, and SHA-256 of the input
files), calibration.html, masks/. A second run with the same photographs reads these files.
"""

import json
from collections.abc import Iterable, Mapping
from contextlib import suppress
from dataclasses import dataclass, replace
from importlib.metadata import version
from pathlib import Path

import cv2
import numpy as np
from jaxtyping import Bool, UInt8

from pipeline.imaging.silhouette import Silhouette
from pipeline.warnings import ReportWarning
from rig.camera import Intrinsics
from rig.capture import Capture, ReadImage
from rig.errors import InputError
from rig.files import sha256_of, write_atomically
from rig.formats.cameras.cameras_file import find_rig_file, misplaced_fault, read_rig_file
from rig.formats.cameras.cameras_json import CAMERAS_MOST, read_rig, write_rig
from rig.formats.cameras.scale_json import read_scale
from rig.formats.captures.capture_folder import (
    SCALE,
    capture_root,
    full_size_reader,
    has_known_length,
    read_capture,
    read_rig_of,
    read_shot,
    unread_files,
    unread_pictures,
)
from rig.formats.captures.shot_files import find_files, picture_folder
from rig.formats.pictures.images import is_picture, picture_size, write_image
from rig.formats.pictures.picture_names import entry
from rig.formats.pictures.work_size import WORK_PIXELS, work_rig
from rig.messages.message import Message, compose, documents_of, read_message, say_once
from rig.plausibility import rig_faults
from rig.progress import Progress
from rig.rig import Rig, spread_views

JSON_BYTES_MOST = 16 << 20  # of cameras.json and its like; 64 cameras with all feature points have .5 MB
CAMERAS, FIGURES, PAGE, CACHE = "cameras.json", "calibration.json", "calibration.html", ".cache"


@dataclass(frozen=True, slots=True, eq=False)
class Prepared:
    """Holds the capture and rig that ``reconstruct`` needs, and the warnings from estimating the cameras."""

    capture: Capture
    rig: Rig
    warnings: tuple[ReportWarning, ...]


def photographs_alone(folder: Path) -> bool:
    """Returns whether a folder has photographs of a head but no cameras, so that these must be estimated."""
    root = capture_root(folder)
    if find_rig_file(root) is not None or misplaced_fault(root) is not None:
        return False
    found = (path for depth in ("*", "*/*") for path in picture_folder(root).glob(depth))  # as find_photographs looks
    return any(map(is_picture, found))


def read_or_calibrate(folder: Path, kept: Path, *, front: str | None, report: Progress) -> Prepared:
    """Reads a capture folder. Missing cameras are estimated from the photographs and written to ``kept``.

    Raises InputError naming every fault, and CalibrationRefused naming the unregistered views and what to add.
    """
    if not photographs_alone(folder):
        return Prepared(*read_scaled_capture(folder), ())
    from calibration.scene.photographs import find_photographs

    root = capture_root(folder)
    warnings = calibrate_photographs(root, kept, front=front, report=report)
    rig, faults = read_rig(kept / CAMERAS), list[Message]()
    files = find_files(root, rig, [name for name in find_photographs(root).names if name not in rig])
    faults += files.faults
    capture = read_shot(root, rig, faults, files, pixels_most=WORK_PIXELS)
    if faults:
        raise InputError("capture", say_once(faults, rig.names))
    warnings += tuple(unread_pictures(root, files, rig))
    digests = {**capture.digests, CAMERAS: sha256_of(kept / CAMERAS)}
    return Prepared(replace(capture, digests=dict(sorted(digests.items()))), work_rig(rig, WORK_PIXELS), warnings)


def read_scaled_capture(folder: Path, *, pixels_most: int | None = WORK_PIXELS) -> tuple[Capture, Rig]:
    """Reads a capture folder with its cameras. With a scale.json beside them the cameras are scaled to millimetres.
    ``pixels_most``: larger pictures are reduced to that many pixels.

    Raises InputError naming every fault, also if the scaled cameras are in no plausible unit.
    """
    capture, rig = read_capture(folder, pixels_most=pixels_most)
    root = capture_root(folder)
    rig_file = find_rig_file(root)
    if rig_file is None or not has_known_length(root):
        return capture, rig
    from calibration.scene.scale import scale_by_length

    scaled, remarks = scale_by_length(capture, rig, read_rig_file(rig_file), read_scale(entry(root, SCALE), rig.names))
    if faults := rig_faults(scaled):
        raise InputError("capture", [f"{rig_file.name}, scaled by {SCALE}: {fault}" for fault in faults])
    return replace(capture, remarks=(*capture.remarks, *remarks)), scaled


def full_size_pictures(folder: Path, kept: Path) -> ReadImage:
    """Returns a function that reads a capture's pictures at the size of their files. Estimated cameras lie in
    ``kept``."""
    root = capture_root(folder)
    read = read_rig_of(find_rig_file(root) or kept / CAMERAS)
    return full_size_reader(root, read.rig, [*read.left_out])


def calibrate_photographs(root: Path, kept: Path, *, front: str | None, report: Progress) -> tuple[ReportWarning, ...]:
    """Calibrates the cameras of photographs and writes cameras.json and the report to ``kept``. Does nothing if the
    same photographs were calibrated before. Returns the warnings. Raises InputError and CalibrationRefused."""
    made_of = _made_of(root, front)
    if (told_before := calibration_warnings(kept, made_of)) is not None:
        return told_before
    from calibration.scene.result import scene_page
    from calibration.scene.scene import calibrate_scene

    scale = entry(root, SCALE)
    found = calibrate_scene(root, scale=scale if scale.is_file() else None, front=front, report=report)
    warnings = [compose("view-left-out", remark=absence) for absence in found.absences()]
    warnings += unread_files(root, [])
    if found.scale.assumed:
        warnings.append(compose("scale-assumed", scale=found.scale.provenance))
    rig = found.rig
    if len(rig) > CAMERAS_MOST:
        rig = rig.subset(spread_views(rig, CAMERAS_MOST))
        warnings.append(compose("views-many", joined=len(found.rig), most=CAMERAS_MOST))
    write_rig(rig, kept / CAMERAS)
    write_atomically(kept / PAGE, scene_page(found).encode())
    document = {
        "made_of": made_of,
        "cameras_sha256": sha256_of(kept / CAMERAS),
        "told": documents_of(warnings),
        **found.document(),
    }
    write_atomically(kept / FIGURES, json.dumps(document, indent=1).encode())
    return tuple(warnings)


def calibration_warnings(kept: Path, made_of: Mapping[str, str] | None = None) -> tuple[ReportWarning, ...] | None:
    """Returns the warnings that ``calibrate_photographs`` wrote to ``kept``. Returns None if ``kept`` has none, if
    cameras.json was changed since, or if it was made from other files than ``made_of`` (SHA-256 by name)."""
    with suppress(OSError, ValueError, KeyError, TypeError):
        document = json.loads((kept / FIGURES).read_text(encoding="utf-8"))
        same = made_of is None or document["made_of"] == made_of
        if same and document["cameras_sha256"] == sha256_of(kept / CAMERAS):
            return tuple(map(read_message, document["told"]))
    return None


def check_sizes(files: Iterable[Path], image_pixels: int) -> None:
    """Raises InputError naming every picture with more than ``image_pixels`` pixels. Sizes are read from the files'
    headers, before anything is decoded."""
    sizes = {path: picture_size(path) for path in files}
    huge = [f"{path.name} is {w} x {h} pixels" for path, (w, h) in sizes.items() if w * h > image_pixels]
    if huge:
        raise InputError("capture", [f"{fault}; at most {image_pixels:,} pixels are accepted" for fault in huge])


def keep_masks(kept: Path, capture: Capture, rig: Rig, *, report: Progress) -> dict[str, Silhouette]:
    """Returns the silhouettes of a capture. Masks that were estimated from the photographs alone are also written to
    masks/ in ``kept``. A second run reads these masks from the hidden folder ``CACHE``."""
    from pipeline.segmentation.segment import segment
    from server.storage.silhouette_cache import SUFFIX, segment_once

    if capture.masks or capture.backgrounds:
        return segment(capture, rig, report=report)
    masks, cache = kept / "masks", kept / CACHE
    full = read_rig(kept / CAMERAS) if (kept / CAMERAS).is_file() else rig
    before = set(cache.glob(f"*{SUFFIX}"))
    found = segment_once(cache, capture, rig, report=report)
    made = set(cache.glob(f"*{SUFFIX}")) - before
    for path in before if made else ():
        path.unlink(missing_ok=True)
    for name, silhouette in found.items():
        if made or not (masks / f"{name}.png").is_file():
            write_image(masks / f"{name}.png", _of_file(silhouette.mask, full[name].intrinsics))
    return found


def _of_file(mask: Bool[np.ndarray, "h w"], k: Intrinsics) -> UInt8[np.ndarray, "y x"]:
    """Returns a mask at the size of its picture's file, because the picture may have been reduced."""
    large = cv2.resize(mask.astype(np.uint8) * np.uint8(255), (k.width, k.height), interpolation=cv2.INTER_LINEAR)
    return (large > 127).astype(np.uint8) * np.uint8(255)


def _made_of(root: Path, front: str | None) -> dict[str, str]:
    """Returns the SHA-256 of every input of a calibration."""
    files = [path for path in sorted(picture_folder(root).rglob("*")) if is_picture(path)]
    files += [path for path in sorted(entry(root, "masks").glob("*")) if is_picture(path)]
    files += [path for path in (entry(root, SCALE),) if path.is_file()]
    digests = {path.relative_to(root).as_posix(): sha256_of(path) for path in files}
    return {**digests, "front": front or "", "version": version("eigenhead"), "pycolmap": version("pycolmap")}
