"""Implements ``eigenhead batch``: reconstructs many captures, one result folder each, and makes a table of all."""

from collections.abc import Sequence
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any

import typer

from rig.errors import EigenheadError, InputError, how_to_install
from rig.messages.message import compose
from server.cli.answers import (
    Anyway,
    Data,
    Json,
    Strict,
    answer,
    fail,
    prepare_folder,
    terminated_like_interrupted,
    warn,
    wrong_usage,
)
from server.cli.heads import Detail, Formats, Method, Model, Surface

if TYPE_CHECKING:
    from server.batch.captures import BatchCapture
    from server.batch.plan import BatchTask
    from server.batch.run import Outcome
    from server.batch.shards import Shard

app = typer.Typer(rich_markup_mode=None)
NAMED_MOST = 10  # failed captures that the last line names; the table lists all


class CapturesFailed(EigenheadError):
    """Reports at the end of a batch that some captures failed; the results of the others are complete."""

    def __init__(self, failed: Sequence[str], count: int) -> None:
        names = [*failed[:NAMED_MOST], *(["..."] if len(failed) > NAMED_MOST else [])]
        super().__init__(compose("batch-failed", count=len(failed), all=count, names=names))


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
    from server.batch.plan import plan_batch
    from server.tasks.settings_file import settings_document

    share = _share(shard)
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


def _share(text: str | None) -> "Shard":
    from server.batch.shards import WHOLE, read_shard

    with wrong_usage("--shard"):
        return WHOLE if text is None else read_shard(text)


def _captures_in(captures: Path, out: Path) -> "tuple[BatchCapture, ...]":
    """Returns the captures of a folder or list. Raises InputError for a wrong list, and if ``out`` lies within a
    capture."""
    from server.batch.captures import find_captures, is_archive, read_list

    if captures.is_file() and is_archive(captures):
        raise InputError(captures.name, [compose("batch-folder-is-capture")])
    captures_found = find_captures(captures, out) if captures.is_dir() else read_list(captures)
    out_folder = out.resolve()
    faults = [
        compose("batch-out-within", out=str(out), capture=capture.name)
        for capture in captures_found
        if out_folder.is_relative_to(capture.path.resolve())
    ]
    if faults:
        raise InputError("out", faults)
    return captures_found


def _run(tasks: "Sequence[BatchTask]", out: Path, workers: int | None, share: "Shard", json_out: bool) -> None:
    from server.batch.folder import BatchFolder
    from server.batch.run import BatchRun, free_memory, threads_of_worker, usable_cores, worker_count
    from server.batch.summary import write_summary
    from server.batch.table_files import has_parquet
    from server.cli.batch_display import BatchDisplay

    share_tasks = [task for task in tasks if share.takes(task.capture.name)]
    folder, cores = BatchFolder(out), usable_cores()
    count = workers or worker_count(cores, free_memory(), len(share_tasks))
    files: list[Path] = []
    with terminated_like_interrupted(), BatchDisplay.opened(count, share_tasks) as display:
        display.prepare(share_tasks)
        variables = {"EIGENHEAD_THREADS": str(threads_of_worker(cores, count))} | _threads_variable()
        run = BatchRun(folder, share_tasks, workers=count, variables=variables, observer=display, shard=share)
        outcomes = run.run(lambda: files.extend(write_summary(folder, tasks)))
    failed = [outcome for outcome in outcomes if outcome.state == "failed"]
    _warn_of_versions(folder, share_tasks)
    if not has_parquet():
        warn(compose("batch-no-parquet", install=how_to_install("parquet")).text)
    answer(_document(outcomes, out, files, share, count, display.seconds()), json_out, [str(file) for file in files])
    if failed:
        fail(str(CapturesFailed([outcome.name for outcome in failed], len(share_tasks))))


def _threads_variable() -> dict[str, str]:
    """Returns EIGENHEAD_THREADS if it is set in the environment: the user's choice goes before our own."""
    import os

    from pipeline.compute.threads import THREADS

    return {THREADS: os.environ[THREADS]} if os.environ.get(THREADS) else {}


def _warn_of_versions(folder: Any, tasks: "Sequence[BatchTask]") -> None:
    origins = [(folder.origin(task.capture.name), task.version) for task in tasks]
    others = sum(origin is not None and origin.version != version for origin, version in origins)
    if others:
        warn(compose("batch-other-version", count=others).text)


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
