"""``eigenhead reconstruct``: one capture without the service, in this process."""

import json
from collections.abc import Iterator, Mapping
from contextlib import ExitStack, closing, contextmanager
from pathlib import Path
from typing import TYPE_CHECKING

from rig.atomic_write import write_atomically
from rig.formats.capture_folder import capture_root
from rig.formats.shot_files import BESIDE_PICTURES, picture_folder
from rig.progress import Progress
from server.cli.answers import CannotWrite, SpoilsCapture, prepare_file
from server.processes import share_one_heap
from server.storage.result_folder import fresh_folder
from server.tasks.child import WorkerContext
from server.tasks.progress import JobProgress
from server.tasks.reconstruct_folder import folder_of, reconstruct_folder

if TYPE_CHECKING:
    from pipeline.results.report_types import Report as ReportDocument
    from pipeline.settings import Settings


def reconstruct_locally(
    capture: Path,
    out: Path,
    *,
    model: str | None,
    settings: Mapping[str, object],
    report: Progress,
    trace: Path | None = None,
) -> "ReportDocument":
    """Reconstructs a capture folder or archive into ``out`` and returns report.json; cameras and masks that had to be
    found are kept in ``out``, whatever comes after. What can be wrong with settings, model, template,
    capture, ``out`` and ``trace`` is found before anything heavy is loaded. In ``trace`` is what ran when, also of
    a job that failed."""
    from pipeline.settings import settings_from_document
    from pipeline.templates.header import check_template

    share_one_heap()
    chosen = settings_from_document(settings)
    check_template(chosen.outputs.template, model or "default")
    check_apart(out, capture)
    if trace is not None:
        check_apart(trace.parent, capture, "--trace")
        prepare_file(trace, option="--trace")
    with _traced(trace), _result_folder(out) as fresh, folder_of(capture) as folder:
        _reconstruct_folder(folder, fresh, kept=out, model=model, chosen=chosen, report=report)
        document = json.loads((fresh / "report.json").read_text(encoding="utf-8"))
    return document


def _reconstruct_folder(
    folder: Path, out: Path, *, kept: Path, model: str | None, chosen: "Settings", report: Progress
) -> None:
    from server.tasks.stage_durations import StageDurations

    durations = StageDurations()
    progress = JobProgress(durations.of(chosen))

    def tell(stage: str, fraction: float) -> None:
        progress.report(stage, fraction)
        report(stage, progress.progress())

    with closing(WorkerContext()) as context:
        reconstruct_folder(
            context, tell, folder=folder, out=out, kept=kept, model=model, chosen=chosen, preparation=report
        )  # fmt: skip
    durations.learn(chosen, progress.finish())


def check_apart(out: Path, capture: Path, option: str = "--out") -> None:
    """Raises SpoilsCapture where the pictures of a result would be taken for the capture's."""
    from server.tasks.photographs import photographs_alone

    if not capture.is_dir():
        return
    place, whole, root = out.resolve(), capture.resolve(), capture_root(capture).resolve()
    pictures = [root / kind for kind in ("images", *BESIDE_PICTURES)]
    pictures += [picture_folder(root)] if photographs_alone(root) else []  # any folder there is a camera's
    beside_root = place.is_relative_to(whole) and not place.is_relative_to(root)  # which is told by being alone
    if place == root or beside_root or any(place.is_relative_to(folder) for folder in pictures):
        raise SpoilsCapture(out, option)


@contextmanager
def _traced(path: Path | None) -> Iterator[None]:
    """Records the block, and writes what ran in it to ``path``, however it ends."""
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


@contextmanager
def _result_folder(out: Path) -> Iterator[Path]:
    with ExitStack() as stack:
        try:
            fresh = stack.enter_context(fresh_folder(out))
        except OSError as error:
            raise CannotWrite(out, error) from error
        yield fresh
