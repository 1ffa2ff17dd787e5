"""The task of a job, which runs in a worker's child process: it reads files, calls ``reconstruct()`` and writes
files."""

from collections.abc import Mapping
from dataclasses import replace
from functools import partial
from pathlib import Path
from typing import Protocol

from server.processes import share_one_heap, tidied
from server.tasks.child import Report, WorkerContext

DONE = "done"  # the pipeline's last word, when nothing is written yet


class CaptureWork(Protocol):
    """Declares the function that a worker runs for a job: ``reconstruct_capture``, or the one that the setting ``work``
    names."""

    def __call__(
        self,
        context: WorkerContext,
        report: Report,
        /,
        *,
        capture: str,
        result: str,
        cache: str,
        model: str | None,
        settings: Mapping[str, object],
    ) -> object:
        """Works on the capture folder ``capture`` and writes the folder ``result``; ``cache`` is a folder for what a
        later job of the capture may use again."""
        ...


def reconstruct_capture(
    context: WorkerContext,
    report: Report,
    *,
    capture: str,
    result: str,
    cache: str,
    model: str | None,
    settings: Mapping[str, object],
) -> None:
    """Reconstructs the capture folder ``capture`` and writes the result to the folder ``result``. Silhouettes are
    cached in the folder ``cache``.

    Raises InputError for an input that cannot be used, other EigenheadErrors of the pipeline, OSError for a full disk,
    and Cancelled if ``report`` raises it.
    """
    report("read", 0.0)  # a fresh child loads for seconds what this takes
    share_one_heap()
    from pipeline.applications.templates.write.writers import load_template_writers
    from pipeline.head_model.model import load_model
    from pipeline.reconstruct import reconstruct
    from pipeline.results.write import write_result
    from pipeline.settings import settings_from_document
    from pipeline.stages.context import ReconstructionContext
    from rig.render.renderer import Renderer
    from server.storage.silhouette_cache import segment_once
    from server.tasks.matching_device import matching_device
    from server.tasks.photographs import calibration_warnings, full_size_pictures, read_scaled_capture
    from server.tasks.prepare import prepare_kernels

    chosen, once = settings_from_document(settings), partial(segment_once, Path(cache))
    kind = f"{chosen.detail} {chosen.outputs.surface}"
    context.keep(f"loops {kind}", lambda: prepare_kernels(lambda _, share: report("compiling", share), chosen))
    name = model or "default"
    head_model = context.keep(f"model {name}", lambda: load_model(name))
    writers = load_template_writers(chosen.outputs.template, head_model)
    renderer = context.keep("renderer", Renderer.create)
    shot, rig = read_scaled_capture(Path(capture))

    def tell(stage: str, fraction: float) -> None:
        if stage != DONE:  # the files are still to be written
            report(stage, fraction)

    done = reconstruct(
        ReconstructionContext(
            shot,
            rig,
            head_model,
            chosen,
            renderer,
            tidied(tell),
            once,
            device=matching_device(context, chosen, renderer),
            read_original=full_size_pictures(Path(capture), Path(capture)) if chosen.detail == "pores" else None,
        )
    )
    report("write", 0.0)
    warnings = calibration_warnings(Path(capture)) or ()
    done = replace(done, warnings=(*warnings, *done.warnings))
    write_result(Path(result), done, shot, writers)
