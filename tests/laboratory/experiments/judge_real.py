"""Implements ``eigenhead experiments real FOLDER...``: judges heads from real captures by views that their fit did not
use.

Cameras are estimated first if a folder has none.
"""

from dataclasses import replace
from pathlib import Path
from tempfile import TemporaryDirectory
from typing import TYPE_CHECKING

from rig.errors import InputError
from rig.formats.captures.capture_folder import capture_root
from rig.formats.captures.outlines_json import read_outlines
from rig.progress import Progress
from server.tasks.photographs import read_or_calibrate
from server.tasks.prepare import prepare_kernels

if TYPE_CHECKING:
    from tests.laboratory.experiments.faults.real import RealCapture
    from tests.laboratory.experiments.outcome import Outcome

OUTLINES = "outlines.json"


def judge_folders(
    folders: list[Path],
    *,
    model: str,
    front: str | None,
    outlines: Path | None,
    kept: Path | None,
    report: Progress,
) -> "Outcome":
    """Computes the experiment's figures for every folder.

    ``outlines`` is a file of outlines drawn by hand, allowed for a single folder only; by default a folder's own
    outlines.json is read. The estimated cameras and the table of figures are written to ``kept``. Raises InputError.
    """
    if outlines is not None and len(folders) > 1:
        raise InputError("--outlines", ["belongs to one folder; put outlines.json into each of several"])
    from pipeline.head_model.model import load_model
    from pipeline.settings import Settings
    from rig.atomic_write import write_atomically
    from rig.render.renderer import Renderer
    from tests.laboratory.experiments.faults.real import real
    from tests.laboratory.experiments.markdown import of_figures

    settings = Settings()
    prepare_kernels(report, settings)
    with TemporaryDirectory() as scratch, Renderer.create() as renderer:
        place = kept or Path(scratch)
        captures = [read_real_capture(folder, place / folder.name, front, outlines, report) for folder in folders]
        found = real(load_model(model), captures, renderer=renderer, settings=settings, report=report)
    if kept is not None:
        write_atomically(kept / "real.md", of_figures(found["figures"]).encode())
    return found


def read_real_capture(
    folder: Path, kept: Path, front: str | None, outlines: Path | None, report: Progress
) -> "RealCapture":
    """Reads a folder for the experiment ``real``. Its masks and drawn outlines serve as the reference, its feature
    points are not used. Estimated cameras are written to ``kept``."""
    from tests.laboratory.experiments.faults.real import RealCapture

    prepared = read_or_calibrate(folder, kept, front=front, report=report)
    default = capture_root(folder) / OUTLINES
    path = outlines or (default if default.is_file() else None)
    drawn = {} if path is None else read_outlines(path, prepared.rig)
    # A mask that the folder has serves as reference too; an outline drawn by hand replaces it.
    drawn = {**prepared.capture.masks, **drawn}
    return RealCapture(folder.name, replace(prepared.capture, features={}), prepared.rig, drawn, front)
