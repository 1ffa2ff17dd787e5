"""A forked command is what an exec'd one is: what it says, how it ends, what signals do to it, whose child it is."""

import os
import signal
import subprocess
import sys
from pathlib import Path

import pytest

from tests.support import fork_server
from tests.support.fork_server import ExecPopen, Popen
from tests.support.services import ROOT

CLI = [sys.executable, "-m", "server.cli"]


@pytest.mark.parametrize(
    ("words", "status"),
    [(["--version"], 0), (["keys", "list", "--json"], 0), (["--colour"], 2), (["reconstruct", "/nowhere"], 2)],
)
def test_it_says_and_ends_as_one_that_was_execd(words: list[str], status: int, tmp_path: Path) -> None:
    outcomes = []
    for start in (Popen, ExecPopen):
        with start(
            [*CLI, *words],
            env=os.environ | {"EIGENHEAD_DATA": str(tmp_path), "PYTHONPATH": str(ROOT)},
            cwd=tmp_path,
            stdout=subprocess.PIPE,
            stderr=subprocess.PIPE,
        ) as process:
            outcomes.append((*process.communicate(timeout=60), process.returncode))
    assert outcomes[0] == outcomes[1]
    assert outcomes[0][2] == status


def test_it_is_a_child_with_a_session_variables_and_files_of_its_own(tmp_path: Path) -> None:
    environment = os.environ | {"EIGENHEAD_DATA": str(tmp_path), "EIGENHEAD_LABEL": "forked"}
    command = [*CLI, "worker", "--until-eof"]
    mask = signal.pthread_sigmask(signal.SIG_BLOCK, [signal.SIGUSR1])
    try:
        process = Popen(
            command,
            env=environment,
            cwd=tmp_path,
            stdin=subprocess.PIPE,
            stderr=subprocess.PIPE,
            start_new_session=True,
        )
    finally:
        signal.pthread_sigmask(signal.SIG_SETMASK, mask)
    try:
        at = Path(f"/proc/{process.pid}")
        shown = at.joinpath("cmdline").read_bytes().rstrip(b"\0").split(b"\0")
        assert shown == [os.fsencode(word) for word in command]
        assert set(at.joinpath("environ").read_bytes().rstrip(b"\0").split(b"\0")) == {
            os.fsencode(f"{name}={value}") for name, value in environment.items()
        }
        assert at.joinpath("cwd").readlink() == tmp_path
        assert os.getsid(process.pid) == process.pid
        status = dict(line.split(":\t") for line in at.joinpath("status").read_text().splitlines() if ":\t" in line)
        assert int(status["PPid"]) == os.getpid()
        assert int(status["SigBlk"], 16) & 1 << signal.SIGUSR1 - 1
        assert process.stderr is not None
        while b"worker ready" not in (line := process.stderr.readline()):
            assert line, "it ended"
        assert process.poll() is None
    finally:
        process.kill()
    assert process.wait(10) == -signal.SIGKILL
    process.stderr.close()
    assert process.stdin is not None
    process.stdin.close()


def test_what_the_interpreter_reads_at_its_start_is_execd() -> None:
    here = dict(os.environ)
    assert fork_server._forkable([*CLI, "--help"], here) == ("server.cli", ["--help"])
    assert fork_server._forkable([*CLI, "--help"], here | {"PYTHONHASHSEED": "1"}) is None
    assert fork_server._forkable([*CLI, "--help"], here | {"PYTHONPATH": "/elsewhere"}) is None
    assert fork_server._forkable([sys.executable, "-c", "print()"], here) is None
