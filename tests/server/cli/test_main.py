"""The command line: help, usage errors, one clear line, JSON alone on stdout."""

import json
import os
import signal
import subprocess
import sys
from pathlib import Path
from typing import get_args, get_type_hints

import pytest
import typer

from pipeline import settings
from pipeline.settings import OutputSettings, Settings
from rig.files import write_atomically
from rig.formats.cameras.cameras_file import FORMATS, write_rig_file
from rig.formats.cameras.dataset_json import DATASET_FORMATS
from server.cli import answers, main
from server.cli.answers import service_settings
from server.cli.cameras import CameraFormat
from server.cli.export import ExportFormat
from tests.support import fork_server
from tests.support.services import ROOT, small_capture
from tests.support.small_captures import small_rig

COMMANDS = [
    *("serve", "worker", "check", "reconstruct", "verify", "simulate", "demo", "prepare", "doctor", "board"),
    *("calibrate", "keys add", "keys list", "keys remove", "rig check", "rig preview", "rig capture", "rig plates"),
    *("model list", "model info", "model import", "model remove"),
    *("template add", "template list", "template remove"),
]  # fmt: skip


def run(*arguments: str, timeout_s: float = 120.0, **environment: str) -> "subprocess.CompletedProcess[str]":
    command = [sys.executable, "-m", "server.cli", *arguments]
    return fork_server.run(command, timeout_s, env=os.environ | environment, cwd=ROOT)


@pytest.mark.parametrize("command", COMMANDS)
def test_every_command_has_help_with_an_example(command: str) -> None:
    done = run(*command.split(), "--help")
    assert done.returncode == 0
    assert f"Example: eigenhead {command}" in done.stdout or "eigenhead worker" in done.stdout


def test_commands_are_listed_in_rooms_and_choices_are_those_of_the_settings() -> None:
    shown = run("--help").stdout
    assert [line[:-1] for line in shown.splitlines() if line.endswith(":")][1:] == [
        title for title, _ in main.ROOMS.values()
    ]
    shown = " ".join(run("reconstruct", "--help").stdout.split())
    for name, kind in (("method", Settings), ("detail", Settings), ("device", Settings), ("surface", OutputSettings)):
        types = get_type_hints(kind)[name]
        values = [value for option in (types, *get_args(types)) for value in get_args(option) if isinstance(value, str)]
        assert f"--{name} <{'|'.join(dict.fromkeys(values))}>" in shown
    assert get_args(CameraFormat) == FORMATS
    assert get_args(ExportFormat) == (*settings.FORMATS, "slicer", "dicom", "nifti", *DATASET_FORMATS)
    assert "\n  One share of eight: eigenhead batch study.csv" in run("batch", "--help").stdout


def test_quiet_leaves_errors_alone_and_a_log_gets_lines_of_progress(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    monkeypatch.setattr(answers, "LINE_S", 0.0)
    with answers.progress_bar() as report:
        report("fit", 0.25)
    assert capsys.readouterr().err == "eigenhead: fit 25%\n"
    source = write_rig_file(small_rig(), tmp_path / "transforms.json", "nerfstudio") or tmp_path / "transforms.json"
    source.write_text(source.read_text().replace("{", '{"of_nobody": 1, ', 1))
    command = ("convert", str(source), "--threads", "2", "--out")
    assert "of_nobody" in run(*command, str(tmp_path / "a.json")).stderr
    assert run(*command, str(tmp_path / "b.json"), "--quiet").stderr == ""
    assert run(*command, str(tmp_path / "no" / "\0"), "--quiet").returncode != 0


def test_ctrl_c_leaves_one_line_on_what_was_written(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    def write_and_stop(out: str) -> None:
        write_atomically(Path(out, "part"), b"")
        os.kill(os.getpid(), signal.SIGTERM)

    again = "run the same command again to go on"
    for name, said in (("take", again), ("verify", f"{tmp_path} is not complete")):
        with pytest.raises(typer.Exit, match="130"):
            answers.stoppable(write_and_stop, name)(out=str(tmp_path))
        assert capsys.readouterr().err == f"eigenhead: Stopped; {said}\n"


def test_a_full_disk_is_named(monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]) -> None:
    monkeypatch.setattr(main, "app", lambda: Path("/dev/full").write_bytes(b"full"))
    with pytest.raises(SystemExit, match="1"):
        main.main()
    assert capsys.readouterr().err == "eigenhead: the disk is full: make room, then run the same command again\n"


def test_a_failure_is_one_clear_line_and_status_1(tmp_path: Path) -> None:
    folder = small_capture(tmp_path / "capture")
    (folder / "images" / "cam01.png").unlink()
    done = run("reconstruct", str(folder), "--out", str(tmp_path / "out"), "--json")
    assert (done.returncode, done.stdout) == (1, "")
    assert done.stderr.startswith("eigenhead: capture: images/cam01.png is missing")
    assert done.stderr.count("\n") == 1
    (tmp_path / "bad.zip").write_bytes(b"no archive")
    done = run("reconstruct", str(tmp_path / "bad.zip"), "--out", str(tmp_path / "out"))
    assert done.returncode == 1
    assert "no .zip, .tar or .tar.gz" in done.stderr
    assert not (tmp_path / "out").exists()


@pytest.mark.parametrize(
    ("name", "value", "text"),
    [
        ("CORS_ORIGINS", "abc", "is no JSON"),
        ("PORT", "abc", "valid integer"),
        ("DATABASE_URL", "foo", "postgresql://HOST/NAME or sqlite"),
        ("DATABASE_URL", "mysql://a/b", "'mysql' is no database"),
        ("DATABASE_URL", "postgresql://a:port/b", "is no database's URL"),
    ],
)
def test_a_wrong_variable_is_wrong_usage(name: str, value: str, text: str, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setenv(f"EIGENHEAD_{name}", value)
    with pytest.raises(typer.BadParameter) as refused:
        service_settings()
    assert refused.value.message.startswith(f"EIGENHEAD_{name}")
    assert text in refused.value.message


@pytest.mark.slow
@pytest.mark.gl
def test_the_doctor_finds_a_healthy_machine_and_names_what_is_wrong(tmp_path: Path) -> None:
    done = run("doctor", "--json", EIGENHEAD_DATA=str(tmp_path))
    findings = json.loads(done.stdout)
    assert findings["egl"]["ok"]
    assert findings["model"]["ok"]
    (tmp_path / "eigenhead.sqlite").write_bytes(b"no database" * 1000)
    done = run("doctor", EIGENHEAD_DATA=str(tmp_path))
    assert done.returncode == 1
    assert "WRONG  database" in done.stdout
