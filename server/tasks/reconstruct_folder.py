"""The task of the command line: reconstructs a capture on a user's disk. Archives are unpacked; cameras and masks that
are missing are estimated and kept.

A job of the service has its capture checked and stored before (``server.tasks.ingest``).
"""

import os
import tempfile
from collections.abc import Iterator, Mapping
from contextlib import contextmanager
from dataclasses import replace
from functools import partial
from pathlib import Path
from typing import TYPE_CHECKING

from rig.formats.captures.archive import extract_archive
from rig.progress import Progress
from server.processes import end_with_parent, share_one_heap, tidied
from server.tasks.child import WorkerContext

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
    from server.tasks.photographs import full_size_pictures, keep_masks, read_or_calibrate
    from server.tasks.prepare import prepare_kernels

    with span("stage", "read"):
        prepared = read_or_calibrate(folder, kept, front=chosen.front, report=preparation)
    kind = f"{chosen.method} {chosen.detail} {chosen.outputs.surface}"
    with span("stage", "compiling"):
        context.keep(f"loops {kind}", lambda: prepare_kernels(preparation, chosen))
    from pipeline.applications.templates.write.writers import load_template_writers
    from pipeline.head_model.model import load_model
    from pipeline.reconstruct import reconstruct
    from pipeline.results.write import write_result
    from pipeline.stages.context import ReconstructionContext
    from rig.render.renderer import Renderer
    from server.tasks.matching_device import matching_device

    report("read", 0.0)
    name = model or "default"
    with span("stage", "read"):
        head_model = context.keep(f"model {name}", lambda: load_model(name))
        writers = load_template_writers(chosen.outputs.template, head_model)
        renderer = context.keep("renderer", Renderer.create)
        device = matching_device(context, chosen, renderer)
    segment = partial(keep_masks, kept)
    reconstruction = ReconstructionContext(
        prepared.capture,
        prepared.rig,
        head_model,
        chosen,
        renderer,
        tidied(report),
        segment,
        device=device,
        read_original=full_size_pictures(folder, kept) if chosen.detail == "pores" else None,
    )
    done = reconstruct(reconstruction)
    done = replace(done, warnings=(*prepared.warnings, *done.warnings))
    report("write", 0.0)
    with span("stage", "write"):
        write_result(out, done, prepared.capture, writers)


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
