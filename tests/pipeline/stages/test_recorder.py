"""Stages are run in order, under their own names, and leave warnings and seconds behind."""

import time
from dataclasses import replace

import pytest

from pipeline.head_model.model import load_model
from pipeline.settings import Settings
from pipeline.stages.context import ReconstructionContext
from pipeline.stages.recorder import Recorder, Staged
from rig.capture import Capture
from rig.errors import Cancelled
from rig.messages.message import compose
from rig.render.renderer import Renderer
from tests.support.scenes import fan

PAUSE_S = 0.02
DIM, BESIDE = compose("view", remark="cam00: dim"), compose("view", remark="cam01: dim")


def measure(context: ReconstructionContext, number: int) -> Staged[int]:
    context.progress("what the room beneath calls itself", 0.5)
    time.sleep(PAUSE_S)
    return Staged(number + 1, [DIM])


def double(context: ReconstructionContext, number: int, *, times: int) -> Staged[int]:
    return Staged(number * times)


def run_measure(run: Recorder) -> int:
    with run.stage("measure") as stage:
        return stage.keep(measure(stage.context, 1))


@pytest.fixture
def context(renderer: Renderer) -> ReconstructionContext:
    return ReconstructionContext(Capture({}), fan(), load_model(), Settings(), renderer)


def test_products_pass_on_and_progress_has_the_name_of_the_stage(context: ReconstructionContext) -> None:
    seen: list[tuple[str, float]] = []

    def note(name: str, fraction: float) -> None:
        seen.append((name, fraction))

    run = Recorder(replace(context, progress=note))
    with run.stage("measure") as stage:
        number = stage.keep(measure(stage.context, 1))
    with run.stage("double") as stage:
        assert stage.keep(double(stage.context, number, times=3)) == 6
    assert seen == [("measure", 0.0), ("measure", 0.5), ("double", 0.0)]
    assert run.warnings == (DIM,)


def test_two_visits_of_a_stage_share_its_seconds(context: ReconstructionContext) -> None:
    run = Recorder(context)
    for _ in range(2):
        run_measure(run)
    seconds = run.seconds()
    assert list(seconds) == ["measure", "total"]
    assert 2 * PAUSE_S <= seconds["measure"] <= seconds["total"]


def test_a_cancelled_job_begins_no_stage(context: ReconstructionContext) -> None:
    def cancel(name: str, fraction: float) -> None:
        raise Cancelled

    run = Recorder(replace(context, progress=cancel))
    with pytest.raises(Cancelled):
        run_measure(run)
    assert list(run.seconds()) == ["total"]
    assert run.warnings == ()


def slowly(context: ReconstructionContext, pauses: int, done: list[int]) -> Staged[int]:
    for pause in range(pauses):
        context.progress("within", pause / pauses)
        time.sleep(PAUSE_S)
        done.append(pause)
    return Staged(pauses, [BESIDE])


def test_a_stage_beside_has_the_seconds_waited(context: ReconstructionContext, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setenv("EIGENHEAD_THREADS", "2")
    reported: list[str] = []
    run, done = Recorder(replace(context, progress=lambda name, _: reported.append(name))), list[int]()
    with run.beside("slowly", lambda quiet: slowly(quiet, 5, done)) as pending:
        run_measure(run)
    assert pending.product == 5
    assert done == [*range(5)]
    assert {*reported} == {"measure"}, "only what the job waits for tells how far it is"
    assert run.warnings == (DIM, BESIDE)
    seconds = run.seconds()
    assert seconds["slowly"] + seconds["measure"] <= seconds["total"] + 1e-3


@pytest.mark.parametrize("threads", ["1", "2"])
def test_a_failed_block_stops_the_stage_beside_it(
    context: ReconstructionContext, monkeypatch: pytest.MonkeyPatch, threads: str
) -> None:
    monkeypatch.setenv("EIGENHEAD_THREADS", threads)
    run, done = Recorder(context), list[int]()
    pauses = 200 if threads == "2" else 2
    with pytest.raises(Cancelled), run.beside("slowly", lambda quiet: slowly(quiet, pauses, done)):
        raise Cancelled
    assert len(done) < 100
    held = len(done)
    time.sleep(3 * PAUSE_S)
    assert len(done) == held, "nothing works on when the job has ended"


@pytest.mark.parametrize("threads", ["1", "2"])
def test_a_failing_thread_fails_the_job(
    context: ReconstructionContext, monkeypatch: pytest.MonkeyPatch, threads: str
) -> None:
    monkeypatch.setenv("EIGENHEAD_THREADS", threads)
    run = Recorder(context)
    with pytest.raises(ZeroDivisionError), run.beside("divide", lambda _: Staged(1 // 0)):
        pass
