"""Implements ``eigenhead reconstruct``: reconstructs one capture in this process, without the service."""

import json
import os
from collections.abc import Iterator, Mapping
from contextlib import closing, contextmanager
from pathlib import Path
from typing import TYPE_CHECKING

from rig.capture import TEXTURE_SETS
from rig.files import write_atomically
from rig.formats.captures.capture_folder import capture_root
from rig.formats.captures.shot_files import BESIDE_PICTURES, picture_folder
from rig.progress import Progress
from server.cli.answers import SpoilsCapture, prepare_file, prepare_folder
from server.processes import share_one_heap
from server.storage.result_folder import fresh_folder
from server.tasks.child import WorkerContext
from server.tasks.progress import JobProgress
from server.tasks.reconstruct import folder_of, reconstruct_folder

if TYPE_CHECKING:
    from pipeline.results.report_types import Report as ReportDocument


def reconstruct_locally(
    capture: Path,
    out: Path,
    *,
    model: str | None,
    settings: Mapping[str, object],
    report: Progress,
    trace: Path | None = None,
) -> "ReportDocument":
    """Reconstructs a capture folder or archive into ``out`` and returns the content of report.json.

    Estimated cameras and masks stay in ``out`` even if a later stage fails; an earlier result in ``out`` stays until
    the new result is complete. Settings, model, template, capture, ``out`` and ``trace`` are checked before heavy
    modules are loaded. The file ``trace`` records which thread ran which code and when, even if the job fails.
    """
    from pipeline.applications.templates.header import check_template
    from pipeline.settings import settings_from_document
    from server.tasks.stage_durations import StageDurations, megapixels_of

    share_one_heap()
    chosen = settings_from_document(settings)
    check_template(chosen.outputs.template, model or "default")
    check_apart(out, capture)
    if trace is not None:
        check_apart(trace.parent, capture, "--trace")
        prepare_file(trace, option="--trace")
    prepare_folder(out)
    with _traced(trace), fresh_folder(out) as fresh, folder_of(capture) as folder, closing(WorkerContext()) as context:
        durations, megapixels = StageDurations(), megapixels_of(folder)
        progress = JobProgress(durations.of(chosen, megapixels))

        def tell(stage: str, fraction: float) -> None:
            progress.report(stage, fraction)
            report(stage, progress.progress())

        reconstruct_folder(
            context, tell, folder=folder, out=fresh, kept=out, model=model, chosen=chosen, preparation=report
        )
        durations.learn(chosen, progress.finish(), megapixels)
        return json.loads((fresh / "report.json").read_text(encoding="utf-8"))


def flame_lines(document: "ReportDocument", out: Path) -> list[str]:
    """Returns lines for people on the fit of a FLAME model: its file, and its distance from the head."""
    from rig.formats.meshes.flame_param import FILE

    figures = (document.get("template") or {}).get("flame")
    if figures is None:
        return []
    median, most = figures["residual_median_mm"], figures["residual_p95_mm"]
    return [f"{out / FILE}  FLAME comes as near as {median:.2f} mm (median), {most:.2f} (95 %)"]


def check_apart(out: Path, capture: Path, option: str = "--out") -> None:
    """Raises SpoilsCapture if a later run would read pictures of the result in ``out`` as pictures of the capture."""
    from server.tasks.photographs import photographs_alone

    if not capture.is_dir():
        return
    out_folder = Path(os.path.realpath(out))  # which bears a link to itself
    whole, root = capture.resolve(), capture_root(capture).resolve()
    pictures = [root / kind for kind in ("images", *BESIDE_PICTURES, TEXTURE_SETS)]
    pictures += [picture_folder(root)] if photographs_alone(root) else []  # there every folder counts as a camera's
    # The root is recognised as the only folder within ``whole``: a result beside it would hide it.
    beside_root = out_folder.is_relative_to(whole) and not out_folder.is_relative_to(root)
    if out_folder == root or beside_root or any(out_folder.is_relative_to(folder) for folder in pictures):
        raise SpoilsCapture(out, option)


@contextmanager
def _traced(path: Path | None) -> Iterator[None]:
    """Records which code runs in the block and writes the record to ``path``, even if the block raises."""
    if path is None:
        yield
        return
    from pipeline.compute.threads import thread_count
    from pipeline.compute.trace import Trace, recorded

    trace = Trace()
    try:
        with recorded(trace):
            yield
    finally:
        write_atomically(path, trace.encoded(threads=thread_count()))
