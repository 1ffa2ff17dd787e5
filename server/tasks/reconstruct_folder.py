"""Implements the task of the command line: reconstructs a capture on a user's disk. Archives are unpacked; cameras and
masks that are missing are estimated and kept.

A job of the service has its capture checked and stored before (``server.tasks.ingest``).
"""

import os
import tempfile
from collections.abc import Iterator, Mapping
from contextlib import contextmanager
from functools import partial
from pathlib import Path
from typing import TYPE_CHECKING

from rig.formats.captures.archive import extract_archive
from rig.progress import Progress
from server.processes import end_with_parent, share_one_heap
from server.tasks.child import WorkerContext
from server.tasks.reconstruct import run_job

if TYPE_CHECKING:
    from pipeline.settings import Settings


@contextmanager
def folder_of(capture: Path) -> Iterator[Path]:
    """Yields the folder of a capture. An archive is unpacked to a temporary folder, which is removed after the block.
    Raises InputError."""
    if capture.is_dir():
        yield capture
        return
    with tempfile.TemporaryDirectory() as scratch:
        extract_archive(capture, Path(scratch) / "capture")
        yield Path(scratch) / "capture"


def reconstruct_folder(
    context: WorkerContext,
    report: Progress,
    *,
    folder: Path,
    out: Path,
    kept: Path,
    model: str | None,
    chosen: "Settings",
    preparation: Progress,
) -> None:
    """Reconstructs the capture in ``folder`` and writes the result to ``out``. Cameras and masks that had to be
    estimated are written to ``kept``, even if the reconstruction fails.

    ``preparation`` receives the progress before the first stage: estimating cameras, compiling loops. Raises the errors
    of the pipeline, and OSError for a full disk.
    """
    from pipeline.compute.trace import span
    from server.tasks.photographs import keep_masks, read_or_calibrate

    with span("stage", "read"):
        prepared = read_or_calibrate(folder, kept, front=chosen.front, report=preparation)
    run_job(
        context,
        report,
        prepared,
        out,
        folders=(folder, kept),
        model=model,
        chosen=chosen,
        segment=partial(keep_masks, kept),
        preparation=preparation,
    )


def reconstruct_beside(
    context: WorkerContext,
    report: Progress,
    *,
    parent: int,
    capture: str,
    result: str,
    scratch: str,
    model: str | None,
    settings: Mapping[str, object],
) -> None:
    """Reconstructs a capture folder or archive into the new folder ``result``. It runs in a child process and ends with
    the process ``parent``. All its temporary files lie in the folder ``scratch``."""
    end_with_parent(parent)
    share_one_heap()
    from pipeline.settings import settings_from_document

    os.environ["TMPDIR"] = tempfile.tempdir = scratch
    chosen, out = settings_from_document(settings), Path(result)
    with folder_of(Path(capture)) as folder:
        reconstruct_folder(
            context, report, folder=folder, out=out, kept=out, model=model, chosen=chosen, preparation=report
        )  # fmt: skip
