"""The rig and calibrations over HTTP: the simulated studio, and the recordings of a real board."""

import json
from pathlib import Path

import cv2
import numpy as np
import pytest

from tests.support.services import await_calibration, packed, served_client
from tests.support.shared_data import shared


@pytest.mark.slow
@pytest.mark.gl
@pytest.mark.timeout(400)
def test_the_simulated_rig_takes_captures_previews_and_a_calibration(tmp_path: Path) -> None:
    with served_client(tmp_path / "data") as (_, client):
        rig = client.get("/v1/rig").json()
        assert (rig["kind"], rig["ready"], len(rig["cameras"])) == ("simulated", True, 11)
        preview = client.get("/v1/rig/cameras/cam00/preview.jpg")
        picture = cv2.imdecode(np.frombuffer(preview.content, np.uint8), cv2.IMREAD_COLOR)
        assert picture is not None
        assert picture.shape[1] == 640
        assert client.get("/v1/rig/cameras/cam99/preview.jpg").status_code == 404
        capture = client.post("/v1/captures", json={"seed": 5, "expression": "smile"})
        assert capture.status_code == 201
        document = capture.json()
        assert (document["source"], document["expression"], len(document["cameras"])) == ("rig", "smile", 11)
        assert document["shot"]["kind"] == "simulated"
        again = client.post("/v1/captures", json={"seed": 5}).json()
        assert again["inputs"] == document["inputs"]


@pytest.mark.slow
@pytest.mark.timeout(400)
def test_an_archive_of_board_pictures_becomes_a_calibration(tmp_path: Path) -> None:
    board = shared("data/multicam-board")
    folder = tmp_path / "board"
    for camera in ("cam_0", "cam_1", "cam_2", "cam_3"):
        (folder / "IMAGES" / camera).mkdir(parents=True)
        for path in (board / camera).iterdir():
            (folder / "IMAGES" / camera / path.name).write_bytes(path.read_bytes())
    (folder / "board.toml").write_bytes((board / "board.toml").read_bytes())
    with served_client(tmp_path / "data") as (_, client):
        made = client.post("/v1/calibrations", files={"file": packed(folder)}, data={"label": "Monday" * 100})
        assert made.status_code == 202, made.text
        done = await_calibration(client, made.json()["id"])
        assert done["state"] == "succeeded", done["error"]
        assert done["label"] == ("Monday" * 100)[:500]
        assert done["figures"]["rms_px"] <= 1.1
        cameras = client.get(made.headers["location"] + "/cameras.json").json()
        assert [camera["name"] for camera in cameras["cameras"]] == ["cam_0", "cam_1", "cam_2", "cam_3"]
        assert b"<html" in client.get(made.headers["location"] + "/report.html").content[:2000].lower()
        other = client.put("/v1/rig/calibration", json={"calibration_id": done["id"]})
        assert other.status_code == 409  # the studio has eleven other cameras
        (folder / "board.toml").write_text('kind = "checkerboard"\ncolumns = 1\n')
        bad = client.post("/v1/calibrations", files={"file": packed(folder)})
        assert bad.status_code == 422
        assert any("rows is missing" in error for error in bad.json()["errors"])
        assert [c["id"] for c in client.get("/v1/calibrations").json()["calibrations"]] == [done["id"]]
        json.dumps(done, allow_nan=False)
        assert client.delete(made.headers["location"]).status_code == 204
