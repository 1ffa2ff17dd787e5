"""The rig's commands against the studio that ``eigenhead simulate --serve`` keeps running, as operators type them."""

import json
import signal
import socket
import subprocess
import sys
import urllib.request
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from rig.formats.captures.capture_folder import read_capture
from rig.studio.scene.layout import default_layout
from tests.support import fork_server

NAMES = tuple(f"cam{i:02}" for i in range(11))
ROOT = Path(__file__).resolve().parents[2]
CLI = [sys.executable, "-m", "server.cli"]
START_S, STOP_S = 180.0, 20.0


@pytest.mark.slow
@pytest.mark.gl
@pytest.mark.timeout(300)
def test_a_served_studio_is_checked_captured_and_closed(tmp_path: Path) -> None:
    folder = tmp_path / "studio"
    with served_studio(folder, "--seed", "3", "--gaze", "12", "-5") as studio:
        assert tuple(studio["cameras"]) == NAMES
        box = Path(studio["trigger"]["port"])
        assert str(box.readlink()) == studio["trigger"]["terminal"]
        with urllib.request.urlopen(studio["url"] + "/", timeout=10) as page:
            assert b"subject seated" in page.read()
        checked = command("rig", "check", "--rig", studio["rig"])
        assert checked["healthy"]
        assert [row["remark"] for row in checked["cameras"]] == ["ok"] * 11
        taken = command("rig", "capture", "--rig", studio["rig"], "--out", str(tmp_path / "one"))
        assert taken["faults"] == []
        assert set(taken["sync"]["cameras"]) == set(NAMES)
        assert all(
            line["status"] == "in sync" and line["skew_ms"] is not None for line in taken["sync"]["cameras"].values()
        )
        capture, rig = read_capture(tmp_path / "one")
        assert rig.names == NAMES
        np.testing.assert_allclose(rig["cam04"].centre_world, default_layout()["cam04"].centre_world, atol=1e-6)
        assert capture.images["cam00"].shape == (768, 1024, 3)
        assert all(len(capture.backgrounds[name]) == 5 for name in NAMES)
        hung = urllib.request.Request(studio["url"] + "/faults?kind=hung&camera=cam07", method="POST")
        urllib.request.urlopen(hung, timeout=10).close()
        with pytest.raises(subprocess.CalledProcessError) as failed:
            command("rig", "capture", "--rig", studio["rig"], "--out", str(tmp_path / "two"))
        assert failed.value.returncode == 1
        assert "cam07: missing" in failed.value.stderr
        assert not (tmp_path / "two").exists()
    assert not box.is_symlink()
    host, port = studio["url"].removeprefix("http://").split(":")
    with pytest.raises(ConnectionRefusedError):
        socket.create_connection((host, int(port)), timeout=2.0)
    assert (tmp_path / "studio.truth" / "head.ply").is_file()
    eyes = json.loads((tmp_path / "studio.truth" / "meta.json").read_text())["eyes_world"]
    assert set(eyes) == {"right", "left"}


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
