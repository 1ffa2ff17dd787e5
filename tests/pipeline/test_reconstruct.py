"""The order of the stages, a job that is cancelled in any of them, and a result with a warning that is refused."""

import hashlib
import json
from dataclasses import replace
from pathlib import Path

import pytest

from pipeline.compute.trace import Trace, recorded
from pipeline.evidence.plausibility import ImplausibleResult
from pipeline.head_model.model import load_model
from pipeline.reconstruct import reconstruct
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
SPAN = Settings(detail="span", outputs=OutputSettings(surface="head"))


def context_of(half_size_shot: SimulatedCapture, renderer: Renderer) -> ReconstructionContext:
    return ReconstructionContext(half_size_shot.capture, half_size_shot.rig, load_model(), SPAN, renderer)


@pytest.mark.slow
def test_stages_come_in_the_order_of_the_method(half_size_shot: SimulatedCapture, renderer: Renderer) -> None:
    visits: list[str] = []
    fractions: dict[str, list[float]] = {}

    def note(name: str, fraction: float) -> None:
        if fraction == 0.0 or name == "done":
            visits.append(name)
        fractions.setdefault(name, []).append(fraction)

    result = reconstruct(replace(context_of(half_size_shot, renderer), progress=note))
    began = [name for i, name in enumerate(visits) if i == 0 or visits[i - 1] != name]
    assert tuple(began) == STAGES
    assert set(result.seconds) == {*STAGES, "total"} - {"done"}
    assert all(0.0 <= fraction <= 1.0 for reported in fractions.values() for fraction in reported)


@pytest.mark.slow
@pytest.mark.parametrize("visit", range(len(STAGES) - 1), ids=[f"{k}-{name}" for k, name in enumerate(STAGES[:-1])])
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


@pytest.mark.slow
def test_a_warning_that_the_settings_name_refuses_the_result(
    half_size_shot: SimulatedCapture, renderer: Renderer
) -> None:
    context = context_of(half_size_shot, renderer)
    capture = replace(context.capture, remarks=(compose("file-unread", remark="notes.txt is not read"),))
    noticed = replace(context, capture=capture)
    assert "file-unread" in [warning.code for warning in reconstruct(noticed).warnings]
    with pytest.raises(ImplausibleResult, match=r"file-unread: notes\.txt"):
        reconstruct(replace(noticed, settings=replace(SPAN, fail_on=("file-unread",))))


@pytest.mark.slow
@pytest.mark.timeout(600)
def test_any_number_of_threads_makes_the_same_bytes_traced_or_not(
    half_size_shot: SimulatedCapture, renderer: Renderer, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    context = replace(context_of(half_size_shot, renderer), settings=Settings())

    def digests(name: str, threads: int, trace: Trace | None = None) -> dict[str, str]:
        monkeypatch.setenv("EIGENHEAD_THREADS", str(threads))
        with recorded(trace):
            result = reconstruct(context)
            write_result(tmp_path / name, result, context.capture)
        files = [path for path in (tmp_path / name).rglob("*.*") if path.name != "report.json"]  # it has seconds
        return {
            path.relative_to(tmp_path / name).as_posix(): hashlib.sha256(path.read_bytes()).hexdigest()
            for path in files
        }

    trace = Trace()
    one = digests("one", 1, trace)  # cut as finely as for sixteen
    assert {"head.ply", "head.glb", "bust.ply"} <= one.keys()
    assert digests("two", 2) == one
    assert digests("four", 4) == one
    events = json.loads(trace.encoded(threads=1))["traceEvents"]
    began = [event["name"] for event in events if event.get("cat") == "stage"]
    assert [name for k, name in enumerate(began) if k == 0 or began[k - 1] != name] == list(TRACED)
