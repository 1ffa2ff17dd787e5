"""What the commands that make heads say beside their answer."""

import json
import shutil
import signal
import subprocess
import sys
from contextlib import nullcontext
from pathlib import Path
from typing import Any

import pytest
from typer.testing import CliRunner

from pipeline.compute.trace import active_trace, span
from rig.errors import EigenheadError
from rig.progress import discard_progress
from server.cli import reconstruct_local
from server.cli.answers import SpoilsCapture
from server.cli.main import app
from tests.support.services import ROOT, await_true, small_capture


@pytest.mark.parametrize("as_json", [False, True])
def test_warnings_of_a_result_reach_the_terminal_and_the_status_stays_0(
    monkeypatch: pytest.MonkeyPatch, tmp_path: Path, as_json: bool
) -> None:
    warnings = [
        {"code": "cameras-exchanged", "message": "cam04 and cam06 hold each other's pictures"},
        {"code": "scale-implausible", "message": "too large"},
    ]
    monkeypatch.setattr(reconstruct_local, "reconstruct_locally", lambda *_, **__: {"warnings": warnings})
    capture = small_capture(tmp_path / "capture")
    arguments = ["reconstruct", str(capture), "--out", str(tmp_path / "out"), *(["--json"] if as_json else [])]
    done = CliRunner().invoke(app, arguments)
    assert done.exit_code == 0
    assert done.stderr.splitlines() == [f"eigenhead: {w['code']}: {w['message']}" for w in warnings]
    if as_json:
        assert json.loads(done.stdout)["warnings"] == warnings


def test_a_format_that_does_not_exist_is_wrong_usage_and_the_others_reach_the_settings(
    monkeypatch: pytest.MonkeyPatch, tmp_path: Path
) -> None:
    requested: list[Any] = []

    def reconstructed(*positional: Any, settings: dict[str, Any], **named: Any) -> dict[str, Any]:
        requested.append(settings)
        return {"warnings": []}

    monkeypatch.setattr(reconstruct_local, "reconstruct_locally", reconstructed)
    arguments = ["reconstruct", str(small_capture(tmp_path / "capture")), "--out", str(tmp_path / "out")]
    wrong = CliRunner().invoke(app, [*arguments, "--formats", "glb,fbx"])
    assert (wrong.exit_code, requested) == (2, [])
    assert "'fbx' is none of glb, ply, obj, usdz, stl, 3mf" in " ".join(wrong.stderr.replace("│", " ").split())
    for more in (["--formats=glb, usdz"], ["--albedo"], ["--cap=blue"], ["--cap=#2458ac", "--cap-thickness=0.6"]):
        assert CliRunner().invoke(app, [*arguments, *more]).exit_code == 0
    wanted = [("outputs", {"formats": ["glb", "usdz"]}), ("outputs", {"albedo": "file"}), ("cap", {"colour": "blue"})]
    wanted.append(("cap", {"colour": "#2458ac", "thickness_mm": 0.6}))
    assert [settings[key] for settings, (key, _) in zip(requested, wanted, strict=True)] == [one for _, one in wanted]
    for option in ("--obj", "--atlas", "--delight"):  # of versions before 0.3.0
        refused = CliRunner().invoke(app, [*arguments, option])
        assert refused.exit_code == 2
        assert f"No such option: {option}" in refused.stderr


@pytest.mark.parametrize("enclosed", [False, True])
@pytest.mark.parametrize("inside", ["", "images", "images/head", "background", "masks/x", "images/../images"])
def test_a_result_never_lies_among_the_pictures_of_its_capture(inside: str, enclosed: bool, tmp_path: Path) -> None:
    capture = tmp_path / "capture"
    folder = small_capture(capture / "anna" if enclosed else capture)
    photographs = Path(shutil.copytree(folder / "images", tmp_path / "photographs"))  # a capture without cameras.json
    before = sorted(tmp_path.rglob("*"))
    for out in [folder / inside, *([capture / "head"] if enclosed else [])]:
        with pytest.raises(SpoilsCapture, match="name another place with --out"):
            reconstruct_local.reconstruct_locally(capture, out, model=None, settings={}, report=discard_progress)
    within = photographs / "out"
    with pytest.raises(SpoilsCapture):
        reconstruct_local.reconstruct_locally(photographs, within, model=None, settings={}, report=discard_progress)
    assert sorted(tmp_path.rglob("*")) == before


@pytest.mark.parametrize("fails", [False, True])
def test_a_trace_is_written_of_every_job_and_may_lie_in_the_result(
    monkeypatch: pytest.MonkeyPatch, tmp_path: Path, fails: bool
) -> None:
    def reconstructed(*_: Any, out: Path, **named: Any) -> None:
        with span("stage", "fit"):
            if fails:
                raise OSError("no head")
        (out / "report.json").write_text("{}")

    monkeypatch.setattr(reconstruct_local, "reconstruct_folder", reconstructed)
    capture, out = small_capture(tmp_path / "capture"), tmp_path / "out"
    with pytest.raises(OSError, match="no head") if fails else nullcontext():
        reconstruct_local.reconstruct_locally(
            capture, out, model=None, settings={}, report=discard_progress, trace=out / "trace.json"
        )
    events = json.loads((out / "trace.json").read_text())["traceEvents"]
    assert [event["name"] for event in events if event["ph"] == "X"] == ["job", "fit"]
    assert (out / "report.json").exists() is not fails
    assert active_trace() is None


def test_a_trace_that_cannot_be_written_or_spoils_the_capture_is_refused_before_the_work(
    monkeypatch: pytest.MonkeyPatch, tmp_path: Path
) -> None:
    monkeypatch.setattr(reconstruct_local, "reconstruct_folder", lambda *_, **__: pytest.fail("the work began"))
    capture = small_capture(tmp_path / "capture")
    (tmp_path / "file").write_text("x")
    for place, why in {
        capture / "cameras.json": "lies where the capture's own pictures do; name another place with --trace",
        tmp_path / "file" / "trace.json": "cannot be written .* name another place with --trace",
    }.items():
        before = sorted(tmp_path.rglob("*"))
        arguments = ["reconstruct", str(capture), "--out", str(tmp_path / "out"), "--trace", str(place)]
        with pytest.raises(EigenheadError, match=why):
            CliRunner().invoke(app, arguments, catch_exceptions=False)
        assert sorted(tmp_path.rglob("*")) == before


def test_a_scheduler_ends_a_reconstruction_and_nothing_is_left(tmp_path: Path) -> None:
    script = (
        "import pathlib, time\nfrom server.cli import reconstruct_local\n"
        "def work(*a, out, **n):\n    (out / 'begun').touch()\n    time.sleep(60)\n"
        "reconstruct_local.reconstruct_folder = work\nfrom server.cli.main import main\nmain()"
    )
    small_capture(tmp_path / "shot")
    command = [sys.executable, "-c", script, "reconstruct", str(tmp_path / "shot"), "--out", str(tmp_path / "head")]
    with subprocess.Popen(command, cwd=ROOT, stderr=subprocess.DEVNULL) as running:
        await_true(lambda: list(tmp_path.rglob("begun")), 60)
        running.send_signal(signal.SIGTERM)
        assert running.wait(45) == 130
    assert [path.name for path in tmp_path.iterdir()] == ["shot"]
