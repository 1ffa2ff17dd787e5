"""Implements the task of a job: it reads files, calls ``reconstruct()`` and writes files.

``run_job`` runs both kinds of job: a service's, in a worker's child process, for a checked and stored capture; and the
command line's, for a capture on a user's disk, whose archive is unpacked and whose missing cameras and masks are
estimated.
"""

import os
import tempfile
from collections.abc import Iterator, Mapping
from contextlib import contextmanager
from dataclasses import replace
from functools import partial
from pathlib import Path
from typing import TYPE_CHECKING

from pipeline.settings import Settings, settings_from_document
from rig.formats.captures.archive import extract_archive
from rig.messages.message import compose
from rig.progress import Progress
from server.processes import end_with_parent, share_one_heap, tidied
from server.tasks.child import WorkerContext

if TYPE_CHECKING:
    from pipeline.stages.context import Segment
    from pipeline.warnings import ReportWarning
    from rig.render.compute import ComputeDevice
    from rig.render.renderer import Renderer
    from server.tasks.photographs import Prepared


DONE = "done"  # the pipeline's last word, when nothing is written yet
SURE_SCALE = 0.02  # relative: 3 mm of a head; above it the warning says that lengths are estimates


def reconstruct_capture(
    context: WorkerContext,
    report: Progress,
    *,
    capture: str,
    result: str,
    cache: str,
    model: str | None,
    settings: Mapping[str, object],
) -> None:
    """Reconstructs the capture folder ``capture`` and writes the result to the folder ``result``. Silhouettes are
    cached in the folder ``cache``. The service's setting ``work`` may name another function with these parameters.

    Raises InputError for an input that cannot be used, other EigenheadErrors of the pipeline, OSError for a full disk,
    and Cancelled if ``report`` raises it.
    """
    report("read", 0.0)  # a fresh child loads for seconds what this takes
    share_one_heap()
    from server.storage.silhouette_cache import segment_once
    from server.tasks.photographs import Prepared, calibration_warnings, read_scaled_capture

    folder, chosen = Path(capture), settings_from_document(settings)
    run_job(
        context,
        report,
        Prepared(*read_scaled_capture(folder), calibration_warnings(folder) or ()),
        Path(result),
        folders=(folder, folder),
        model=model,
        chosen=chosen,
        segment=partial(segment_once, Path(cache)),
        preparation=lambda _, share: report("compiling", share),
    )


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
    chosen: Settings,
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
    """Reconstructs a capture folder or archive into the new folder ``result``. The work runs in a child process and
    ends with the process ``parent``. All temporary files lie in the folder ``scratch``."""
    end_with_parent(parent)
    share_one_heap()

    os.environ["TMPDIR"] = tempfile.tempdir = scratch
    chosen, out = settings_from_document(settings), Path(result)
    with folder_of(Path(capture)) as folder:
        reconstruct_folder(
            context, report, folder=folder, out=out, kept=out, model=model, chosen=chosen, preparation=report
        )  # fmt: skip


def run_job(
    context: WorkerContext,
    report: Progress,
    prepared: "Prepared",
    out: Path,
    *,
    folders: tuple[Path, Path],
    model: str | None,
    chosen: Settings,
    segment: "Segment",
    preparation: Progress,
) -> None:
    """Reconstructs a capture that was read, and writes the result to the folder ``out``. ``folders`` hold the capture's
    files and estimated cameras; ``preparation`` receives the progress of compiling loops.

    Raises the errors of the pipeline, OSError for a full disk, and Cancelled if ``report`` raises it.
    """
    from pipeline.applications.templates.write.writers import load_template_writers
    from pipeline.compute.trace import span
    from pipeline.evidence.plausibility import refuse
    from pipeline.head_model.model import load_model
    from pipeline.reconstruct import reconstruct
    from pipeline.results.write import write_result
    from pipeline.stages.context import ReconstructionContext
    from rig.render.renderer import Renderer
    from server.tasks.photographs import full_size_pictures
    from server.tasks.prepare import prepare_kernels

    refuse(prepared.capture.remarks, chosen.fail_on)
    kind = f"{chosen.method} {chosen.detail} {chosen.outputs.surface}"
    with span("stage", "compiling"):
        context.keep(f"loops {kind}", lambda: prepare_kernels(preparation, chosen))
    report("read", 0.0)
    name = model or "default"
    with span("stage", "read"):
        head_model = context.keep(f"model {name}", lambda: load_model(name))
        writers = load_template_writers(chosen.outputs.template, head_model)
        renderer = context.keep("renderer", Renderer.create)
        device = matching_device(context, chosen, renderer)

    done = reconstruct(
        ReconstructionContext(
            prepared.capture,
            prepared.rig,
            head_model,
            chosen,
            renderer,
            tidied(
                lambda stage, share: None if stage == DONE else report(stage, share)
            ),  # files are still to be written
            segment,
            device=device,
            read_original=full_size_pictures(*folders) if chosen.detail == "pores" else None,
        )
    )
    tidied(report)("write", 0.0)
    done = replace(done, warnings=_with_scale((*prepared.warnings, *done.warnings), done.scale_sigma))
    with span("stage", "write"):
        write_result(out, done, prepared.capture, writers)


MOST_THREADS = 8  # of a processor that a GPU is faster than: of an H200 two threads take 1.5 times as long, 16 no
# longer


def matching_device(context: WorkerContext, chosen: Settings, renderer: "Renderer") -> "ComputeDevice | None":
    """Opens the compute device that ``chosen.device`` names, once in each process. Returns None if the CPU compares
    photographs: with the device ``cpu``, and with ``auto`` if there is no GPU or more than ``MOST_THREADS`` threads.
    Raises ComputeUnavailable if ``gl`` was chosen and is missing."""
    from pipeline.compute.threads import thread_count
    from rig.render.compute import open_device

    if chosen.device == "auto" and thread_count() > MOST_THREADS:
        return None

    description = renderer.context.description
    device: ComputeDevice | None = context.keep(
        f"device {chosen.device}", lambda: open_device(chosen.device, description)
    )
    return device


def _with_scale(warnings: "tuple[ReportWarning, ...]", scale_sigma: float) -> "tuple[ReportWarning, ...]":
    """Adds a warning that the scale is estimated, unless the calibration already has one."""
    if scale_sigma <= SURE_SCALE or any(warning.code == "scale-assumed" for warning in warnings):
        return warnings
    return (compose("scale-assumed", scale=compose("scale-estimated", share=scale_sigma)), *warnings)
