"""Compares the remaining time told after a fifth of a job with what it then takes; jobs are learnt as by a service."""

from contextlib import closing
from pathlib import Path
from time import process_time
from typing import Any

from pipeline.settings import settings_from_document
from server.tasks.child import WorkerContext
from server.tasks.progress import JobProgress
from server.tasks.reconstruct import reconstruct_folder
from server.tasks.stage_durations import StageDurations, megapixels_of

JOBS = [("scan-a", "fine both"), ("three-brows", "kernel head"), ("scan-a", "photo head"), ("scan-a", "kernel head")]
JOBS += [("scan-a", "kernel both"), ("beard-smile", "fine both"), ("three-brows", "fine both"), ("draw-b", "span head")]
JOBS += [("circle-hair", "photo both"), ("draw-b", "fine head"), ("scan-a-skin", "fine both"), ("draw-b", "photo both")]


def run(scratch: Path, *, captures: Path = Path("../shared/data/captures")) -> dict[str, Any]:
    """Returns for each job its seconds and the told by the true remaining time, and how many of these are near 1."""
    found, durations, context = {}, StageDurations(scratch / "paces.json"), WorkerContext()
    with closing(context):
        for name, kind in JOBS:
            chosen = settings_from_document({"detail": kind.split()[0], "outputs": {"surface": kind.split()[1]}})
            folder, ends, began = captures / name, list[tuple[float, float]](), process_time()
            progress = JobProgress(durations.of(chosen, megapixels_of(folder)), process_time)

            def tell(stage: str, fraction: float, progress: JobProgress = progress, ends: list[Any] = ends) -> None:
                progress.report(stage, fraction)
                ends.append((process_time(), process_time() + progress.remaining_s()))

            tell("read", 0.0)
            places = {"folder": folder, "out": scratch / f"{name} {kind}", "kept": scratch / f"{name} {kind}"}
            reconstruct_folder(context, tell, **places, model=None, chosen=chosen, preparation=lambda *_: None)
            ended, fifth = process_time(), began + 0.2 * (process_time() - began)
            durations.learn(chosen, progress.finish(), megapixels_of(folder))
            end = [end for at, end in ends if at <= fifth][-1]
            found[f"{name} {kind}"] = (round(ended - began, 1), round((end - fifth) / (ended - fifth), 2))
    return {"figures": found, "near": sum(abs(ratio - 1) <= 1 / 3 for _, ratio in found.values())}
