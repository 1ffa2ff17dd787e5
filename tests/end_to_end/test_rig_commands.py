"""The rig's commands against the studio that ``eigenhead simulate --serve`` keeps running, as operators type them."""

import json
import socket
import subprocess
import urllib.request
from pathlib import Path

import numpy as np
import pytest

from rig.formats.captures.capture_folder import read_capture
from rig.studio.scene.layout import default_layout
from tests.support.served_studio import command, served_studio

NAMES = tuple(f"cam{i:02}" for i in range(11))


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


def test_a_folder_of_somebody_elses_is_not_overwritten(tmp_path: Path) -> None:
    (tmp_path / "cameras.json").write_text("{}")
    with pytest.raises(subprocess.CalledProcessError) as failed:
        command("simulate", str(tmp_path), "--serve")
    assert "holds no simulated studio" in failed.value.stderr
    assert [path.name for path in tmp_path.iterdir()] == ["cameras.json"]


def test_where_the_capture_goes_must_be_said_or_served(tmp_path: Path) -> None:
    with pytest.raises(subprocess.CalledProcessError) as failed:
        command("simulate")
    assert failed.value.returncode == 2
    assert "--serve" in failed.value.stderr
