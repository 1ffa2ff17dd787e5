"""Batches of ``pinned_work``: in this process, or as one of their own.

python -m tests.support.pinned_batch FOLDER OUT [WORKERS] [K/N]
"""

import csv
import hashlib
import json
import sys
from collections.abc import Mapping
from pathlib import Path
from typing import Any

from server.batch.captures import WHOLE, Shard, find_captures, read_shard
from server.batch.folder import BatchFolder
from server.batch.plan import BatchTask, plan_batch
from server.batch.run import BatchRun, Outcome
from server.batch.summary import write_summary
from tests.support.pinned_work import work


def pinned_capture(folder: Path, seed: int, mode: str = "") -> Path:
    (folder / "images").mkdir(parents=True)
    (folder / "images" / "seed.txt").write_text(f"{seed}\n")
    if mode:
        (folder / "mode").write_text(mode)
    return folder


def pinned_captures(folder: Path, count: int) -> Path:
    for seed in range(count):
        pinned_capture(folder / f"s{seed:04}", seed)
    return folder


class Silent:
    """An observer that keeps what it is told."""

    def __init__(self) -> None:
        self.pending = -1
        self.events: list[tuple[str, str]] = []

    def begin(self, pending: int) -> None:
        self.pending = pending

    def report(self, name: str, share: float) -> None:
        assert 0 <= share <= 1

    def end(self, outcome: Outcome) -> None:
        self.events.append((outcome.state, outcome.name))


def plan(folder: Path, out: Path, settings: Mapping[str, object] | None = None) -> tuple[BatchTask, ...]:
    return plan_batch(find_captures(folder, out), settings or {}, None)


def run_pinned(folder: Path, out: Path, *, workers: int = 2, shard: Shard = WHOLE, **options: Any) -> list[Outcome]:
    """A batch of pinned captures in this process; ``given``: as ``BatchRun`` takes it, or ``settings``."""
    tasks = plan(folder, out, options.pop("settings", None))
    target = BatchFolder(out)
    share_tasks = [task for task in tasks if shard.takes(task.capture.name)]
    options = {"observer": Silent(), "variables": {}, "work": work, **options}
    run = BatchRun(target, share_tasks, workers=workers, shard=shard, **options)
    return run.run(lambda: write_summary(target, tasks))


def everything_in(out: Path) -> dict[str, str]:
    """sha256 of every file of a batch, without the seconds that report.json and the tables tell."""
    found = {path.relative_to(out).as_posix(): path for path in out.rglob("*") if path.is_file() or path.is_symlink()}
    return {name: hashlib.sha256(_without_seconds(path)).hexdigest() for name, path in sorted(found.items())}


def _without_seconds(path: Path) -> bytes:
    if path.name == "report.json":
        report = json.loads(path.read_text())
        return json.dumps({key: value for key, value in report.items() if key != "seconds"}).encode()
    if path.name == "heads.parquet":
        import pyarrow.parquet  # it starts a thread, and a process that forks must have none

        rows = pyarrow.parquet.read_table(path).drop_columns("seconds").to_pylist()
        return json.dumps(rows).encode()
    if path.name == "heads.csv":
        with path.open(newline="", encoding="utf-8") as file:
            return json.dumps([row | {"seconds": ""} for row in csv.DictReader(file)]).encode()
    return path.read_bytes()


if __name__ == "__main__":
    folder, out, *more = sys.argv[1:]
    shard = read_shard(more[1]) if len(more) > 1 else WHOLE
    ended = run_pinned(Path(folder), Path(out), workers=int(more[0]) if more else 2, shard=shard)
    print(json.dumps({outcome.name: outcome.state for outcome in ended}))  # noqa: T201
