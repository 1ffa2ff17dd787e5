"""Implements ``eigenhead batch``: reconstructs many captures, each into its own folder, and makes a table of all heads.

Progress is shown as a bar on a terminal, or else (in a scheduler's log) as one line for each capture."""

import os
import sys
import time
from collections.abc import Callable, Iterator, Sequence
from contextlib import contextmanager
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any

import typer

from rig.errors import InputError, how_to_install
from rig.messages.message import compose
from server.cli.answers import QUIET, Anyway, Data, Json, Strict, answer, fail, prepare_folder, warn, wrong_usage
from server.cli.heads import Detail, Formats, Method, Model, Surface

if TYPE_CHECKING:
    from server.batch.captures import BatchCapture, Shard
    from server.batch.plan import BatchTask
    from server.batch.run import Outcome

app = typer.Typer(rich_markup_mode=None)
NAMED_MOST = 10  # failed captures that the last line names; the table lists all


@app.command(
    epilog="Example: eigenhead batch shots --out heads --workers 4   "
    "One share of eight: eigenhead batch study.csv --out heads --shard 3/8"
)
def batch(
    captures: Annotated[
        Path,
        typer.Argument(
            help="A folder with captures below it; or a list: a path a line, or CSV with the columns capture, name, "
            "subject, session, settings.",
            metavar="FOLDER|LIST",
            exists=True,
        ),
    ],
    *,
    out: Annotated[
        Path, typer.Option(help="The folder of all results, with table and contact sheet.", file_okay=False)
    ],
    workers: Annotated[
        int | None, typer.Option(help="Captures at once; by default one a core, as far as memory goes.", min=1, max=512)
    ] = None,
    shard: Annotated[str | None, typer.Option(help="K/N: the K-th of N shares alone, 1/8 say.")] = None,
    method: Method = None,
    model: Model = None,
    detail: Detail = None,
    surface: Surface = None,
    formats: Formats = None,
    anyway: Anyway = False,
    strict: Strict = False,
    settings: Annotated[Path | None, typer.Option(help="More settings, a TOML or JSON file.", exists=True)] = None,
    data: Data = None,
    json_out: Json = False,
) -> None:
    """Reconstruct many captures, and make a table of all heads.

    Stop it at any moment and run it again: only what is missing is made. Status 1 where a capture failed."""
    from server.batch.captures import WHOLE, read_shard
    from server.batch.plan import plan_batch
    from server.tasks.settings_file import settings_document

    with wrong_usage("--shard"):
        share = WHOLE if shard is None else read_shard(shard)
    outputs = {"surface": surface, "formats": formats.split(",") if formats else None}
    requested = {name: value for name, value in outputs.items() if value}
    options = {"outputs": requested or None, "anyway": anyway or None}
    document = settings_document(settings, strict=strict, method=method, detail=detail, **options)
    with wrong_usage("FOLDER|LIST"):
        batch_captures = _captures_in(captures, out)
    with wrong_usage("settings"):
        tasks = plan_batch(batch_captures, document, model)
    prepare_folder(out)
    _run(tasks, out, workers, share, json_out)


def _captures_in(captures: Path, out: Path) -> "tuple[BatchCapture, ...]":
    """Returns the captures of a folder or list. Raises InputError for a wrong list, and if ``out`` lies within a
    capture."""
    from server.batch.captures import find_captures, is_archive, read_list

    if captures.is_file() and is_archive(captures):
        raise InputError(captures.name, [compose("batch-folder-is-capture")])
    captures_found = find_captures(captures, out) if captures.is_dir() else read_list(captures)
    out_folder = Path(os.path.realpath(out))  # which bears a link to itself
    faults = [
        compose("batch-out-within", out=str(out), capture=capture.name)
        for capture in captures_found
        if out_folder.is_relative_to(capture.path.resolve())
    ]
    if faults:
        raise InputError("out", faults)
    return captures_found


def _run(tasks: "Sequence[BatchTask]", out: Path, workers: int | None, share: "Shard", json_out: bool) -> None:
    from pipeline.compute.threads import THREADS
    from server.batch.folder import BatchFolder
    from server.batch.run import BatchRun, free_memory, threads_of_worker, usable_cores, worker_count
    from server.batch.summary import write_summary
    from server.batch.table import has_parquet

    share_tasks = [task for task in tasks if share.takes(task.capture.name)]
    folder, cores = BatchFolder(out), usable_cores()
    count = workers or worker_count(cores, free_memory(), len(share_tasks))
    files: list[Path] = []
    with BatchDisplay.opened(count, share_tasks) as display:
        display.prepare(share_tasks)
        threads = os.environ.get(THREADS) or str(threads_of_worker(cores, count))  # the user's choice goes before ours
        run = BatchRun(folder, share_tasks, workers=count, variables={THREADS: threads}, observer=display, shard=share)
        outcomes = run.run(lambda: files.extend(write_summary(folder, tasks)))
    failed = [outcome for outcome in outcomes if outcome.state == "failed"]
    origins = [(folder.origin(task.capture.name), task.version) for task in share_tasks]
    if others := sum(origin is not None and origin.version != version for origin, version in origins):
        warn(compose("batch-other-version", count=others).text)
    if not has_parquet():
        warn(compose("batch-no-parquet", install=how_to_install("parquet")).text)
    document = _document(outcomes, out, files, share, count, display.seconds())
    counts = ", ".join(f"{document[state]} {state}" for state in ("made", "kept", "failed"))
    answer(document, json_out, [*map(str, files), counts])
    if failed:
        names = [outcome.name for outcome in failed[:NAMED_MOST]] + ["..."] * (len(failed) > NAMED_MOST)
        fail(compose("batch-failed", count=len(failed), all=len(share_tasks), names=names).text)


def _document(
    outcomes: "Sequence[Outcome]", out: Path, files: Sequence[Path], share: "Shard", workers: int, seconds: float
) -> dict[str, Any]:
    counts = {state: sum(outcome.state == state for outcome in outcomes) for state in ("made", "kept", "failed")}
    failures = [
        {
            "capture": outcome.name,
            "kind": outcome.failure.kind,
            **outcome.failure.message.document(),
            "faults": [fault.document() for fault in outcome.failure.faults],
        }
        for outcome in outcomes
        if outcome.failure is not None
    ]
    return {
        "out": str(out),
        "captures": len(outcomes),
        **counts,
        "failures": failures,
        "files": [str(file) for file in files],
        "shard": str(share),
        "workers": workers,
        "seconds": seconds,
    }


Clock = Callable[[], float]


class BatchProgress:
    """Counts finished captures of a batch, of which ``workers`` run at once. The remaining time is estimated from the
    captures' mean duration or, until the first is done, from ``expected_s``. ``clock`` returns monotonic seconds."""

    def __init__(self, captures: int, workers: int, expected_s: float, clock: Clock = time.monotonic) -> None:
        self._captures, self._workers, self._expected_s, self._clock = captures, workers, expected_s, clock
        self._running: dict[str, tuple[float, float]] = {}  # by name: start time, share done
        self._took: list[float] = []
        self.ended = self.failed = 0

    def report(self, name: str, share: float) -> None:
        """Records the fraction of a capture's work that is done, from 0 (the work begins) to 1."""
        since, _ = self._running.get(name, (self._clock(), 0.0))
        self._running[name] = since, min(1.0, max(0.0, share))

    def end(self, name: str, *, failed: bool) -> None:
        """Records that a capture has ended. The duration of a failed capture does not count for the estimate."""
        since, _ = self._running.pop(name, (self._clock(), 0.0))
        self.ended += 1
        self.failed += failed
        if not failed:
            self._took.append(self._clock() - since)

    def share(self) -> float:
        """Returns the fraction of the whole batch that is done, from 0 to 1."""
        begun = sum(share for _, share in self._running.values())
        return min(1.0, (self.ended + begun) / max(1, self._captures))

    def remaining_s(self) -> float:
        """Estimates the remaining seconds, assuming that all workers stay busy."""
        mean_s = sum(self._took) / len(self._took) if self._took else self._expected_s
        waiting = max(0, self._captures - self.ended - len(self._running))
        begun = [mean_s * (1.0 - share) for _, share in self._running.values()]
        at_once = max(1, min(self._workers, waiting + len(begun)))
        return max([(mean_s * waiting + sum(begun)) / at_once, *begun])


def format_time(seconds: float) -> str:
    """Formats a duration in seconds, minutes or hours, rounded as an estimate."""
    if seconds < 90:
        return f"{seconds:.0f} s"
    return f"{seconds / 60:.0f} min" if seconds < 5400 else f"{seconds / 3600:.1f} h"


class BatchDisplay:
    """Shows the events of a batch run, as its ``Observer``. ``bar`` is a progress bar of the library rich, or None if
    standard error is no terminal."""

    def __init__(self, workers: int, expected_s: float, bar: Any = None) -> None:
        self._workers, self._expected_s, self._bar = workers, expected_s, bar
        self._progress = BatchProgress(0, workers, expected_s)
        self._task = None if bar is None else bar.add_task("reading", total=1.0, left="")
        self._count, self._began = 0, time.monotonic()

    @classmethod
    @contextmanager
    def opened(cls, workers: int, tasks: "Sequence[BatchTask]") -> "Iterator[BatchDisplay]":
        """Yields a display that is closed at the end of the block."""
        expected_s = max((sum(task.expected_s.values()) for task in tasks), default=0.0)
        if QUIET.is_set() or not sys.stderr.isatty():
            yield cls(workers, expected_s)
            return
        from rich.console import Console
        from rich.progress import BarColumn, Progress, TextColumn, TimeElapsedColumn

        description, left = TextColumn("{task.description}"), TextColumn("{task.fields[left]}")
        columns = (description, BarColumn(), TimeElapsedColumn(), left)
        with Progress(*columns, console=Console(stderr=True), transient=True) as bar:
            yield cls(workers, expected_s, bar)

    def prepare(self, tasks: "Sequence[BatchTask]") -> None:
        """Compiles the numerical loops that the batch needs and this machine lacks, so that not every worker compiles
        them again."""
        from pipeline.settings import settings_from_document
        from server.tasks.prepare import prepare_kernels

        kinds = {task.settings_sha256: task.settings for task in tasks}
        for settings in kinds.values():
            prepare_kernels(self._prepared, settings_from_document(settings))

    def begin(self, pending: int) -> None:
        """Begins to show progress of ``pending`` captures."""
        self._count, self._progress = pending, BatchProgress(pending, self._workers, self._expected_s)
        self._show()

    def report(self, name: str, share: float) -> None:
        """Shows the fraction of a capture that is done (``share``, 0 to 1)."""
        self._progress.report(name, share)
        self._show()

    def end(self, outcome: "Outcome") -> None:
        """Shows how the work on a capture ended and, if it failed, why."""
        self._progress.end(outcome.name, failed=outcome.state == "failed")
        self._show()
        if outcome.failure is not None:
            self._say(f"eigenhead: {outcome.name}: {outcome.failure.message}")
        elif self._bar is None and outcome.state == "made" and not QUIET.is_set():
            ended, left = self._progress.ended, format_time(self._progress.remaining_s())
            self._say(f"{ended} of {self._count}: {outcome.name} in {outcome.seconds:.0f} s, about {left} left")

    def seconds(self) -> float:
        """Returns the seconds since the display was made."""
        return time.monotonic() - self._began

    def _prepared(self, stage: str, share: float) -> None:
        if self._bar is not None:
            self._bar.update(self._task, description=stage, completed=share)

    def _show(self) -> None:
        if self._bar is None:
            return
        progress = self._progress
        failed = f", {progress.failed} failed" if progress.failed else ""
        description = f"{progress.ended} of {self._count}{failed}"
        left = f"about {format_time(progress.remaining_s())} left"
        self._bar.update(self._task, description=description, completed=progress.share(), left=left)

    def _say(self, line: str) -> None:
        if self._bar is not None:
            self._bar.console.print(line, markup=False, highlight=False)
        else:
            print(line, file=sys.stderr, flush=True)
