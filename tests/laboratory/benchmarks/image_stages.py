"""Seconds of a job's stages, from image files to result files, warm: medians and least of several rounds; peak memory.

python -m tests.laboratory image_stages --detail photo --surface head --json
python -m tests.laboratory image_stages --rounds 2 --steps depth    # the default job

``segmentation`` is eleven 1024 x 768 images, ``texture`` colours the model's full mesh from them. ``total`` is from
opening the first file to the last one written. Processor seconds are those of all threads, which a busy machine
stretches least; peak memory is the most that the process held in a stage, libraries and model included (Linux).
"""

import re
import time
from collections.abc import Collection, Sequence
from dataclasses import replace
from pathlib import Path
from typing import Annotated, Any, Literal

import numpy as np

from pipeline.head_model.model import HeadModel
from pipeline.reconstruct import reconstruct
from pipeline.results.write import write_result
from pipeline.settings import Settings
from pipeline.stages.context import ReconstructionContext
from rig.formats.captures.capture_folder import read_capture
from rig.render.renderer import Renderer


class Meter:
    """Seconds by the clock and of the processor, and peak memory (MB), stage by stage: a job's ``report``."""

    def __init__(self, steps: Collection[str] = ()) -> None:
        self.steps = steps  # stages whose shares have rows of their own: what follows each
        self.wall, self.cpu, self.peak_mb = dict[str, float](), dict[str, float](), dict[str, float]()
        self._stage, self._since = "", (0.0, 0.0)

    def __call__(self, stage: str, share: float) -> None:
        if share and stage not in self.steps:
            return
        row = f"{stage} {share:.2f}" if share else stage
        if row != self._stage:
            self.enter(row)

    def enter(self, stage: str) -> None:
        """What follows belongs to ``stage``; nothing does where that is empty."""
        now = time.perf_counter(), time.process_time()
        if self._stage:
            for seconds, here, before in zip((self.wall, self.cpu), now, self._since, strict=True):
                seconds[self._stage] = seconds.get(self._stage, 0.0) + here - before
            self.peak_mb[self._stage] = max(_peak_mb(), self.peak_mb.get(self._stage, 0.0))
        _forget_peak()
        self._stage, self._since = stage, now


def _peak_mb() -> float:
    """The most memory held since ``_forget_peak``."""
    return int(re.findall(r"VmHWM:\s*(\d+) kB", Path("/proc/self/status").read_text())[0]) / 1024


def _forget_peak() -> None:
    Path("/proc/self/clear_refs").write_text("5")  # proc(5): resets the peak resident set size


def one_round(
    capture_folder: Path, out: Path, model: HeadModel, settings: Settings, renderer: Renderer, steps: Collection[str]
) -> Meter:
    """A job from its files to its results."""
    meter = Meter(steps)
    meter.enter("read")
    capture, rig = read_capture(capture_folder)
    result = reconstruct(ReconstructionContext(capture, rig, model, settings, renderer, meter))
    meter.enter("write")
    write_result(out, result, capture)
    meter.enter("")
    for seconds in (meter.wall, meter.cpu):
        seconds["total"] = sum(seconds.values())
    meter.peak_mb["total"] = max(meter.peak_mb.values())
    return meter


def run(
    model: HeadModel,
    renderer: Renderer,
    scratch: Path,
    *,
    capture: Path = Path("../shared/data/captures/scan-a"),
    detail: Literal["span", "kernel", "photo", "fine"] | None = None,
    surface: Literal["head", "bust", "both"] | None = None,
    rounds: int = 5,
    steps: Annotated[Sequence[str], "stages whose steps have rows, as depth or bust"] = (),
) -> dict[str, Any]:
    """Returns medians and least seconds by stage, and peak memory."""
    settings = replace(Settings(), detail=detail or Settings().detail)
    if surface:
        settings = replace(settings, outputs=replace(settings.outputs, surface=surface))
    inputs = (capture, scratch, model, settings, renderer, steps)
    measured = [one_round(*inputs) for _ in range(1 + rounds)][1:]  # the first reads what was compiled
    stages = list(measured[0].wall)
    found: dict[str, Any] = {"rounds": rounds, "detail": detail or "default"}
    for name, rows in (("s", [row.wall for row in measured]), ("cpu_s", [row.cpu for row in measured])):
        found[f"median_{name}"] = {at: round(float(np.median([row[at] for row in rows])), 3) for at in stages}
        found[f"least_{name}"] = {at: round(min(row[at] for row in rows), 3) for at in stages}
    found["peak_memory_mb"] = {at: round(max(row.peak_mb[at] for row in measured)) for at in stages}
    lines = [f"{'':<14}{'s':>8}{'least':>8}{'CPU s':>8}{'least':>8}{'peak MB':>9}"]
    for at in stages:
        row = [found[name][at] for name in ("median_s", "least_s", "median_cpu_s", "least_cpu_s")]
        lines.append(f"{at:<14}" + "".join(f"{value:8.2f}" for value in row) + f"{found['peak_memory_mb'][at]:9}")
    return {"figures": found, "lines": lines}
