"""``eigenhead simulate --serve`` as a process of its own, and the other commands beside it."""

import json
import signal
import subprocess
import sys
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import Any

from tests.support import fork_server

ROOT = Path(__file__).resolve().parents[2]
CLI = [sys.executable, "-m", "server.cli"]
START_S, STOP_S = 180.0, 20.0


@contextmanager
def served_studio(folder: Path, *options: str) -> Iterator[dict[str, Any]]:
    """What ``--json`` prints once the studio is open. At the end it gets the signal of Ctrl-C and must end well."""
    process = fork_server.Popen(
        [*CLI, "simulate", str(folder), "--serve", "--json", *options], cwd=ROOT, stdout=subprocess.PIPE, text=True
    )
    assert process.stdout is not None
    try:
        line = process.stdout.readline()
        assert line, f"the studio ended with status {process.wait()} before it opened"
        yield json.loads(line)
    finally:
        if process.poll() is None:
            process.send_signal(signal.SIGINT)
        try:
            status = process.wait(STOP_S)
        except subprocess.TimeoutExpired:
            process.kill()
            process.wait()
            raise
        finally:
            process.stdout.close()
    assert status == 0


def command(*arguments: str, timeout_s: float = 600.0) -> dict[str, Any]:
    """What an ``eigenhead`` command prints with --json. Raises CalledProcessError, its words in stderr."""
    done = fork_server.run([*CLI, *arguments, "--json"], cwd=ROOT, timeout_s=timeout_s)
    if done.returncode:
        raise subprocess.CalledProcessError(done.returncode, arguments, done.stdout, done.stderr)
    return json.loads(done.stdout)
