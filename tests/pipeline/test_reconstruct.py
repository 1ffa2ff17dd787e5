"""The order of the stages, a job that is cancelled in any of them, and a result with a warning that is refused."""

import hashlib
import json
from dataclasses import dataclass, replace
from itertools import groupby
from pathlib import Path

import pytest

from pipeline.compute.trace import Trace, recorded
from pipeline.evidence.plausibility import ImplausibleResult
from pipeline.head_model.model import load_model
from pipeline.reconstruct import reconstruct
from pipeline.results.reconstruction import Reconstruction
from pipeline.results.write import write_result
from pipeline.settings import OutputSettings, Settings
from pipeline.stages.context import ReconstructionContext
from rig.errors import Cancelled
from rig.messages.message import compose
from rig.render.renderer import Renderer
from rig.studio.scene.simulate import SimulatedCapture

STAGES = (
    "segmentation", "faces", "alignment", "fit", "parts", "fit", "depth", "fine", "texture", "evidence", "bust", "done",
)  # fmt: skip
# With one thread what runs beside others comes before them: lenses before faces, fusion before the level fine.
TRACED = (
    "segmentation", "faces", "alignment", "fit", "parts", "fit", "depth", "bust", "fine", "bust", "texture", "evidence",
    "bust",
)  # fmt: skip
CANCELLED_EVERY_CHANGE = (1, 4, 7, 9)  # beside lenses, in the middle of the fit, beside fusion, beside the bust
SPAN = Settings(detail="span", outputs=OutputSettings(surface="head"))


def context_of(half_size_shot: SimulatedCapture, renderer: Renderer) -> ReconstructionContext:
    return ReconstructionContext(half_size_shot.capture, half_size_shot.rig, load_model(), SPAN, renderer)


@dataclass(frozen=True)
class Finished:
    """Holds a job's result, what it reported, and the digest of every file but report.json, which has seconds."""

    result: Reconstruction
    reported: list[tuple[str, float]]
    digests: dict[str, str]


def finish(context: ReconstructionContext, folder: Path, threads: int, trace: Trace | None = None) -> Finished:
    reported: list[tuple[str, float]] = []
    with pytest.MonkeyPatch.context() as patch, recorded(trace):
        patch.setenv("EIGENHEAD_THREADS", str(threads))
        result = reconstruct(replace(context, progress=lambda name, fraction: reported.append((name, fraction))))
        write_result(folder, result, context.capture)
    files = [path for path in folder.rglob("*.*") if path.name != "report.json"]
    digests = {path.relative_to(folder).as_posix(): hashlib.sha256(path.read_bytes()).hexdigest() for path in files}
    return Finished(result, reported, digests)


@pytest.fixture(scope="module")
def default_context(half_size_shot: SimulatedCapture, renderer: Renderer) -> ReconstructionContext:
    """A default job whose capture has a remark."""
    context = replace(context_of(half_size_shot, renderer), settings=Settings())
    remark = compose("file-unread", remark="notes.txt is not read")
    return replace(context, capture=replace(context.capture, remarks=(remark,)))


@pytest.fixture(scope="module")
def finished(default_context: ReconstructionContext, tmp_path_factory: pytest.TempPathFactory) -> Finished:
    """The default job in four threads, which three tests read."""
    return finish(default_context, tmp_path_factory.mktemp("four"), 4)


@pytest.mark.slow
def test_stages_come_in_the_order_of_the_method(finished: Finished) -> None:
    visits = [name for name, fraction in finished.reported if fraction == 0.0 or name == "done"]
    assert tuple(name for name, _ in groupby(visits)) == STAGES
    assert set(finished.result.seconds) == {*STAGES, "total"} - {"done"}
    assert all(0.0 <= fraction <= 1.0 for _, fraction in finished.reported)


@pytest.mark.slow
@pytest.mark.timeout(600)
@pytest.mark.parametrize("threads", [1, pytest.param(2, marks=pytest.mark.nightly)])
def test_any_number_of_threads_makes_the_same_bytes_traced_or_not(
    threads: int, finished: Finished, default_context: ReconstructionContext, tmp_path: Path
) -> None:
    trace = Trace() if threads == 1 else None  # cut as finely as for sixteen
    assert finish(default_context, tmp_path, threads, trace).digests == finished.digests
    assert {"head.ply", "head.glb", "bust.ply"} <= finished.digests.keys()
    if trace is not None:
        events = json.loads(trace.encoded(threads=1))["traceEvents"]
        began = [event["name"] for event in events if event.get("cat") == "stage"]
        assert tuple(name for name, _ in groupby(began)) == TRACED


@pytest.mark.slow
def test_a_warning_in_the_settings_refuses_a_result(finished: Finished, default_context: ReconstructionContext) -> None:
    assert "file-unread" in [warning.code for warning in finished.result.warnings]
    with pytest.raises(ImplausibleResult, match=r"file-unread: .*: notes\.txt"):
        reconstruct(replace(default_context, settings=replace(SPAN, fail_on=("file-unread",))))


@pytest.mark.slow
@pytest.mark.parametrize(
    "visit",
    [
        pytest.param(k, id=f"{k}-{name}", marks=[] if k in CANCELLED_EVERY_CHANGE else pytest.mark.nightly)
        for k, name in enumerate(STAGES[:-1])
    ],
)
def test_a_job_is_cancelled_in_any_stage(visit: int, half_size_shot: SimulatedCapture, renderer: Renderer) -> None:
    begun: list[str] = []

    def cancel(name: str, fraction: float) -> None:
        if not begun or begun[-1] != name:
            begun.append(name)
        if len(begun) > visit:
            raise Cancelled

    with pytest.raises(Cancelled):
        reconstruct(replace(context_of(half_size_shot, renderer), progress=cancel))
    assert tuple(begun) == STAGES[: visit + 1]
