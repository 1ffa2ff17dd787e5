"""Compares the remaining time that a job tells after a fifth of its time with what the job then takes.

Each job is learnt from those before it, as a service does.
"""

import tempfile
import time
from contextlib import closing
from pathlib import Path
from typing import Any

from pipeline.settings import settings_from_document
from server.tasks.child import WorkerContext
from server.tasks.progress import JobProgress
from server.tasks.reconstruct_folder import reconstruct_folder
from server.tasks.stage_durations import StageDurations, megapixels_of

JOBS = [("scan-a", "fine both"), ("three-brows", "kernel head"), ("scan-a", "photo head"), ("scan-a", "kernel head")]
JOBS += [("scan-a", "kernel both"), ("beard-smile", "fine both"), ("three-brows", "fine both"), ("draw-b", "span head")]
JOBS += [("circle-hair", "photo both"), ("draw-b", "fine head"), ("scan-a-skin", "fine both"), ("draw-b", "photo both")]
SHARE, NEAR = 0.2, 1 / 3


def run(*, captures: Path = Path("../shared/data/captures")) -> dict[str, Any]:
    """Returns for each job its seconds and the told over the true remaining time, and how many are near 1."""
    found, clock = {}, time.process_time  # of the job: what else runs here is no fault of the estimate
    with tempfile.TemporaryDirectory() as scratch, closing(WorkerContext()) as context:
        durations = StageDurations(Path(scratch) / "paces.json")
        for name, kind in JOBS:
            detail, surface = kind.split()
            chosen = settings_from_document({"detail": detail, "outputs": {"surface": surface}})
            folder, out = captures / name, Path(scratch) / f"{name} {kind}"
            progress, told, began = JobProgress(durations.of(chosen, megapixels_of(folder)), clock), [], clock()

            def tell(stage: str, fraction: float, progress: JobProgress = progress, told: list[Any] = told) -> None:
                told.append((clock(), progress.remaining_s()))
                progress.report(stage, fraction)
                told.append((clock(), progress.remaining_s()))

            reconstruct_folder(
                context, tell, folder=folder, out=out, kept=out, model=None, chosen=chosen, preparation=lambda *_: None
            )  # fmt: skip
            durations.learn(chosen, progress.finish(), megapixels_of(folder))
            took = clock() - began
            at, rest = [(at, rest) for at, rest in told if at <= began + SHARE * took][-1]
            true = took - (at - began)
            found[f"{name} {kind}"] = {"seconds": round(took, 1), "told_over_true": round(rest / true, 2)}
    near = sum(abs(of["told_over_true"] - 1) <= NEAR for of in found.values())
    return {"figures": found, "near": near, "jobs": len(found)}
