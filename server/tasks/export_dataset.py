"""Writes a capture folder as a data set of views for another program.

Cameras, masks and the choice of views are as in a reconstruction. Missing cameras and masks are estimated and stored
beside the data set, or copied from the given result.
"""

import json
import shutil
from collections.abc import Mapping
from dataclasses import replace
from functools import partial
from pathlib import Path
from typing import TYPE_CHECKING, Any

from rig.errors import InputError
from rig.formats.cameras.dataset_json import DatasetFormat
from rig.formats.meshes.flame_param import FILE, read_flame_param
from rig.formats.meshes.ply import read_head_ply
from rig.mesh import Mesh
from rig.messages.message import Message, compose, say_once
from rig.progress import Progress

if TYPE_CHECKING:
    from pipeline.settings import Settings
    from pipeline.warnings import ReportWarning

FOUND = "found"  # cameras and masks that the capture did not have, below the data set's folder
FLAME_FILES = ("flame_param", "canonical_flame_param.npz")
DATASET_FILES = ("images", "masks", "fg_masks", "sparse_pc.ply", "points3d.ply", *FLAME_FILES)
NOT_OF_CAMERAS = ("masks/", "background/", "features.json")  # inputs that may differ where cameras and pictures do not


def export_folder(
    folder: Path, out: Path, form: DatasetFormat, *, result: Path | None, chosen: "Settings", report: Progress
) -> "tuple[dict[str, Any], tuple[ReportWarning, ...]]":
    """Writes the capture in ``folder`` to ``out`` as a data set, replacing an earlier one. With ``result``, the folder
    of its reconstruction, the head is written as a point cloud too. Returns the cameras of the data set, those left
    out, the number of points and whether there are FLAME parameters; and the warnings about the capture.

    Raises InputError naming every fault, also if ``result`` was made from other pictures, and the errors of
    calibration, segmentation and the choice of views.
    """
    from pipeline.results.view_dataset import ViewDataset, write_view_dataset
    from pipeline.settings import OutputSettings
    from pipeline.view_checks.guards import Guards
    from pipeline.view_checks.usable_views import usable_views
    from server.tasks.photographs import keep_masks, photographs_alone, read_or_calibrate
    from server.tasks.prepare import prepare_kernels

    kept, front, head, flame = out / FOUND, chosen.front, None, None
    inputs: Mapping[str, str] = {}
    if result is not None:
        inputs, head = _read_result(result)
        if form == "gaussian-avatars" and (result / FILE).is_file():
            flame = read_flame_param(result / FILE)
        if photographs_alone(folder):
            front = _take_over_found(result, kept) or front
    prepared = read_or_calibrate(folder, kept, front=front, report=report)
    capture, rig = prepared.capture, prepared.rig
    if result is not None and (faults := _differences(inputs, capture.digests)):
        raise InputError(str(result), say_once(faults, rig.names))
    prepare_kernels(report, replace(chosen, detail="span", outputs=OutputSettings(surface="head")))  # no dense loops
    segmented = partial(keep_masks, kept, rig=rig, report=report)
    views = usable_views(capture, rig, segmented, exchanged=chosen.exchanged_pictures, guards=Guards(chosen.anyway))
    dataset = ViewDataset(views.capture, rig, views.silhouettes, head, flame)
    report("write", 0.0)
    for name in DATASET_FILES:
        _remove(out / name)
    for path in out.glob("transforms*.json"):
        _remove(path)
    write_view_dataset(out, dataset, form)
    used = dataset.rig_used.names
    left_out = tuple(name for name in rig.names if name not in used)
    points = 0 if head is None else len(head.vertices)
    figures = {"cameras": used, "left_out": left_out, "points": points, "flame": flame is not None}
    return figures, (*prepared.warnings, *views.warnings)


def _read_result(result: Path) -> tuple[Mapping[str, str], Mesh]:
    """Returns the input files of a result (SHA-256 by file) and its head. Raises InputError."""
    try:
        inputs = json.loads((result / "report.json").read_text(encoding="utf-8"))["inputs"]
    except (OSError, ValueError, KeyError, TypeError) as error:
        raise InputError(str(result), [compose("no-result-folder")]) from error
    return inputs, read_head_ply(result / "head.ply")[0]


def _take_over_found(result: Path, kept: Path) -> str | None:
    """Copies the cameras and masks that a reconstruction estimated, so that the data set has the world frame of its
    head. Returns the front camera that the reconstruction used."""
    from server.tasks.photographs import CACHE, CAMERAS, FIGURES, PAGE

    kept.mkdir(parents=True, exist_ok=True)
    for path in (result / name for name in (CAMERAS, FIGURES, PAGE)):
        if path.is_file():
            shutil.copyfile(path, kept / path.name)
    for name in ("masks", CACHE):
        if (result / name).is_dir():
            shutil.copytree(result / name, kept / name, dirs_exist_ok=True)
    try:
        return json.loads((result / FIGURES).read_text(encoding="utf-8"))["made_of"]["front"] or None
    except (OSError, ValueError, KeyError, TypeError):
        return None


def _differences(inputs: Mapping[str, str], digests: Mapping[str, str]) -> list[Message]:
    """Returns a fault for each picture and camera file that differs from the result's."""
    files = [name for name in digests if not name.startswith(NOT_OF_CAMERAS)]
    return [compose("result-of-other-file", file=name) for name in files if inputs.get(name) != digests[name]]


def _remove(path: Path) -> None:
    if path.is_dir() and not path.is_symlink():
        shutil.rmtree(path)
    else:
        path.unlink(missing_ok=True)
