"""What a new user meets first: one rule for data and keys, clear refusals before the work, nothing overwritten."""

import json
import os
import socket
import subprocess
import sys
from collections.abc import Callable
from dataclasses import dataclass
from importlib.metadata import version
from pathlib import Path

import pytest

from pipeline.head_model.model_names import data_folder, model_path, models_folder
from rig.studio.sensor.faults import KINDS
from server.cli.main import main
from tests.server.cli.test_main import run as run_apart
from tests.support.services import small_capture


@dataclass(frozen=True)
class Done:
    status: int
    out: str
    err: str


Run = Callable[..., Done]


@pytest.fixture
def run(monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str], tmp_path: Path) -> Run:
    """The command line in this process, with a data folder of the test's own."""
    monkeypatch.setenv("EIGENHEAD_DATA", str(tmp_path / "variable"))
    monkeypatch.setenv("OPENBLAS_NUM_THREADS", "1")
    monkeypatch.delenv("EIGENHEAD_MODELS", raising=False)

    def call(*arguments: object) -> Done:
        monkeypatch.setattr(sys, "argv", ["eigenhead", *map(str, arguments)])
        status = 0
        try:
            main()
        except SystemExit as end:
            status = int(end.code or 0)
        captured = capsys.readouterr()
        return Done(status, captured.out, captured.err)

    return call


def test_data_keys_and_models_follow_one_rule(monkeypatch: pytest.MonkeyPatch, tmp_path: Path) -> None:
    for name in ("EIGENHEAD_DATA", "EIGENHEAD_MODELS", "XDG_DATA_HOME"):
        monkeypatch.delenv(name, raising=False)
    monkeypatch.setenv("HOME", str(tmp_path / "home"))
    assert data_folder() == tmp_path / "home/.local/share/eigenhead"
    monkeypatch.setenv("XDG_DATA_HOME", str(tmp_path / "xdg"))
    assert (data_folder(), models_folder()) == (tmp_path / "xdg/eigenhead", tmp_path / "xdg/eigenhead/models")
    monkeypatch.setenv("EIGENHEAD_DATA", str(tmp_path / "data"))
    assert (data_folder(), models_folder()) == (tmp_path / "data", tmp_path / "data/models")
    monkeypatch.setenv("EIGENHEAD_MODELS", str(tmp_path / "models"))
    assert models_folder() == tmp_path / "models"


def test_a_key_is_made_where_data_says_and_says_so(run: Run, tmp_path: Path) -> None:
    made = run("keys", "add", "console", "--scope", "read", "--data", tmp_path / "heads", "--json")
    assert json.loads(made.out)["data"] == str(tmp_path / "heads")
    assert made.err == f"eigenhead: a key of the service whose data is {tmp_path / 'heads'}\n"
    assert not (tmp_path / "variable").exists()
    (listed,) = json.loads(run("keys", "list", "--data", tmp_path / "heads", "--json").out)["keys"]
    assert (listed["id"], listed["name"], listed["scopes"]) == (json.loads(made.out)["id"], "console", ["read"])
    assert json.loads(made.out)["key"].startswith(f"eh_{listed['id']}_")
    for status in (0, 1):
        assert run("keys", "remove", listed["id"], "--data", tmp_path / "heads").status == status


def test_models_lie_in_the_named_data_folder_and_the_users_own_is_removed(run: Run, tmp_path: Path) -> None:
    models = tmp_path / "heads" / "models"
    models.mkdir(parents=True)
    (models / "mine.npz").touch()
    found = json.loads(run("model", "list", "--data", tmp_path / "heads", "--json").out)["models"]
    assert found["mine"] == str(models / "mine.npz")
    assert "mine" not in json.loads(run("model", "list", "--data", tmp_path / "others", "--json").out)["models"]
    (tmp_path / "heads" / "other.npz").touch()
    for name, word in (("default", "comes with the program"), ("nobody", "no head model"), ("../other", "no head")):
        refused = run("model", "remove", name, "--data", tmp_path / "heads")
        assert (refused.status, word in refused.err) == (1, True)
    assert run("model", "remove", "mine", "--data", tmp_path / "heads").status == 0
    assert sorted(path.name for path in (tmp_path / "heads").rglob("*")) == ["models", "other.npz"]


@pytest.mark.parametrize("group", [[], ["keys"], ["rig"], ["model"], ["template"]])
def test_no_summary_of_a_command_is_cut_off(run: Run, group: list[str]) -> None:
    listed = run(*group, "--help").out.partition("-h, --help")[2]
    assert listed.strip()
    assert "..." not in listed


def test_help_version_and_a_model_are_told_in_words(run: Run) -> None:
    text = " ".join(run("simulate", "--help").out.split())
    assert all(kind in text.replace("- ", "-") for kind in KINDS)
    assert run("--version").out == f"eigenhead {version('eigenhead')}\n"
    text = run("model", "info").out
    assert not any(sign in text for sign in "{}[]'\"")
    assert "female: 41; male: 97; total: 138" in text
    assert json.loads(run("model", "info", "--json").out)["landmarks"] == 26
    assert run("model", "info", "nobody").status == 1


@pytest.mark.parametrize(
    ("line", "offered"),
    [
        ("eigenhead mod", ["model"]),
        ("eigenhead reconstruct shots/anna --det", ["--detail"]),
        ("eigenhead reconstruct shots/anna --detail ", ["span", "kernel", "photo", "fine", "pores"]),
        ("eigenhead reconstruct shots/anna --surface b", ["bust", "both"]),
        ("eigenhead reconstruct shots/anna --model mak", ["makehuman-138"]),
        ("eigenhead convert cameras.json --to met", ["metashape"]),
    ],
)
def test_a_shell_completes_commands_options_and_what_they_may_be(line: str, offered: list[str]) -> None:
    words = {"COMP_WORDS": line, "COMP_CWORD": str(len(line.split(" ")) - 1), "_EIGENHEAD_COMPLETE": "complete_bash"}
    command = [str(Path(sys.executable).with_name("eigenhead"))]
    completed = subprocess.run(command, env=os.environ | words, capture_output=True, text=True, timeout=60, check=False)
    assert completed.stdout.split() == offered


def test_serve_says_in_one_line_that_its_rig_file_its_port_or_its_folder_is_no_good(run: Run, tmp_path: Path) -> None:
    done = run("serve", "--rig", tmp_path / "rig.toml")
    assert (done.status, done.err.count("\n")) == (1, 1)
    assert "rig.toml: the file cannot be read (No such file or directory)" in done.err
    with socket.socket() as other:
        other.bind(("127.0.0.1", 0))
        other.listen()
        port = other.getsockname()[1]
        done = run("serve", "--port", port)
    assert (done.status, done.err.count("\n")) == (1, 1)
    assert f"cannot listen on 127.0.0.1:{port}: another program listens there" in done.err
    (tmp_path / "file").touch()
    done = run("serve", "--port", "0", "--data", tmp_path / "file" / "x")
    assert (done.status, done.err.count("\n")) == (1, 1)
    assert "cannot be used (" in done.err


@pytest.mark.parametrize("command", ["serve", "worker"])
def test_a_database_down_is_one_line_without_password(run: Run, monkeypatch: pytest.MonkeyPatch, command: str) -> None:
    with socket.socket() as closed:
        closed.bind(("127.0.0.1", 0))  # and nobody listens
        url = f"postgresql://eigenhead:secret@127.0.0.1:{closed.getsockname()[1]}/heads"
        monkeypatch.setenv("EIGENHEAD_DATABASE_URL", url)
        done = run(command, *(["--port", "0"] if command == "serve" else []))
    assert (done.status, done.err.count("\n")) == (1, 1)
    assert "cannot be used" in done.err
    assert "secret" not in done.err


NUMBERS = ("--noise", "--light-drift", "--defocus", "--rolling-ms", "--fps")


@pytest.mark.parametrize(
    ("line", "words"),
    [
        ("--colour", "No such option: --colour"),
        ("reconstruct", "Missing"),
        ("reconstruct /nowhere --out {out}", "/nowhere"),
        ("reconstruct {shots}/a --out {out} --method magic", "'magic' is not one of"),
        ("reconstruct {shots}/a --out {out} --detail everything", "'everything' is not one of"),
        ("reconstruct {shots}/a --out {out} --surface feet", "'feet' is not one of"),
        ("batch {shots} --out {out} --shard 9/8", "is no share such as 2/8"),
        ("batch {shots} --out {out} --workers 0", "--workers"),
        ("batch {shots} --out {out} --detail deep", "'deep' is not one of 'span', 'kernel', 'photo', 'fine', 'pores'"),
        ("batch {shots} --out {out} --formats fbx", "'fbx' is none of"),
        ("serve --port 99999999", "port: Input should be less than or equal to 65535"),
        ("keys add x --scope everything", "everything"),
        ("simulate", "--serve"),
        *((f"simulate {{out}} {option} {value}", option) for option in NUMBERS for value in ("nan", "inf")),
        ("simulate {out} --realism oily,shiny", "shiny is not one of smooth, oily, scattering, mosaic, jpeg"),
        ("simulate {out} --fault dark:cam00=much", "much"),
        ("simulate {out} --expression mouthSmile=0.5", "mouthSmile"),
        ("board --out {out} --kind chess", "'chess' is not one of"),
        ("board --out {out}.pdf --squares seven", "seven"),
        ("board --out {out}.xyz", "'.xyz': a board is written as .pdf"),
        ("convert {shots}/a --out {out} --to paper", "'paper' is not one of"),
        ("calibrate {shots} --out {out}", "--board"),
        ("calibrate {shots} --out {out} --from sky", "'sky' is not one of 'board', 'scene'"),
        ("calibrate {shots} --out {out} --from scene --lenses two", "'two' is not one of 'one', 'each'"),
        ("calibrate {shots} --out {out} --from scene --board {file}", "is for a board"),
        ("calibrate {shots} --out {out} --scale {file}", "is for --from scene"),
    ],
)
def test_wrong_usage_is_status_2_and_is_named(run: Run, tmp_path: Path, line: str, words: str) -> None:
    file = small_capture(tmp_path / "shots" / "a") / "cameras.json"
    done = run(*line.format(shots=tmp_path / "shots", file=file, out=tmp_path / "out").split())
    assert (done.status, done.out) == (2, "")
    assert words in " ".join(done.err.split())
    assert [path.name for path in tmp_path.iterdir()] == ["shots"]


@pytest.mark.parametrize(
    ("line", "place", "why"),
    [
        ("reconstruct {shot}", "file/inside/out", "cannot be written"),
        ("calibrate {shot} --board {shot}/cameras.json", "file/inside/out", "cannot be written"),
        ("board", "file/inside/out", "cannot be written"),
        ("model build {shot}", "file/inside/out", "cannot be written"),
        ("convert {shot}", "file/cameras.json", "cannot be written"),
        ("convert {shot}", "shot", "it is a folder"),
        ("convert {shot} --to colmap", "file", "it is a file, and a folder is written"),
        ("convert {shot} --to colmap", "file/sparse", "cannot be written"),
    ],
)
def test_an_unwritable_output_is_found_before_work(run: Run, tmp_path: Path, line: str, place: str, why: str) -> None:
    (tmp_path / "file").touch()
    shot = small_capture(tmp_path / "shot")
    done = run(*line.format(shot=shot).split(), "--out", tmp_path / place)
    assert done.status == 1
    assert f"eigenhead: {tmp_path / place} " in done.err
    assert why in done.err


def test_nothing_that_is_there_is_overwritten_unasked(run: Run, tmp_path: Path) -> None:
    (tmp_path / "board.toml").write_text("mine")
    done = run("board", "--out", tmp_path / "board.pdf")
    assert done.status == 1
    assert "board.toml is there already" in done.err
    assert run("board", "--out", tmp_path / "board.pdf", "--overwrite").status == 0
    assert "charuco" in (tmp_path / "board.toml").read_text()
    convert = ("convert", small_capture(tmp_path / "shot"), "--to", "blender", "--out", tmp_path / "cameras.py")
    for more, said in [((), False), ((), True), (("--overwrite",), False)]:
        assert ("result-replaced" in run(*convert, *more).err) is said
    for more, status in [((), 0), ((), 1), (("--overwrite",), 0), (("--name=../evil",), 2), (("--name=default",), 2)]:
        assert run("model", "import", model_path("default"), "--name", "mine", *more).status == status
    capture = small_capture(tmp_path / "capture")
    done = run("simulate", capture)
    assert (done.status, done.err.count("\n")) == (1, 1)
    assert (capture / "cameras.json").is_file()
    assert "holds no simulated studio" in run("simulate", capture, "--serve").err


def test_a_damaged_picture_is_told_in_our_words_alone(tmp_path: Path) -> None:
    """In a process of its own: OpenCV is told to be silent before it is loaded."""
    capture = small_capture(tmp_path / "capture", size=64)
    picture = capture / "images" / "cam01.png"
    data = picture.read_bytes()
    picture.write_bytes(data[: len(data) // 2])
    done = run_apart("reconstruct", str(capture), "--out", str(tmp_path / "out"))
    assert done.returncode == 1
    assert "images/cam01.png" in done.stderr
    assert done.stderr.count("\n") == 1
    assert not (tmp_path / "out").exists()
