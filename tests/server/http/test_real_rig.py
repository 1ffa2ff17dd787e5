"""Real cameras behind the HTTP interface: a service with a rig.toml, and eleven streams and a box that it opens."""

import time
from collections.abc import Iterator
from pathlib import Path

import cv2
import numpy as np
import pytest

from rig.acquisition.commands import take_plates
from rig.formats.cameras.cameras_json import write_rig
from rig.formats.rig_toml import read_rig_config
from rig.studio.devices.serve import DeviceFault, StudioDevices
from server.console.live import rig_frames
from server.console.pages.rig import sync_of
from server.services.service import open_rig
from server.settings import ServiceSettings
from server.tasks.child import Child
from tests.rig.acquisition.test_session import flat_rig
from tests.support.services import served_client
from tests.support.textured_studio import NAMES, FlatStudio

pytestmark = [pytest.mark.slow, pytest.mark.timeout(180)]


@pytest.fixture
def studio(tmp_path: Path) -> Iterator[StudioDevices]:
    folder = tmp_path / "studio"
    write_rig(flat_rig(NAMES), folder / "cameras.json")
    with StudioDevices(folder, NAMES, FlatStudio(False), FlatStudio(True), calibration="cameras.json") as devices:
        take_plates(read_rig_config(folder / "rig.toml"))
        devices.seat(True)
        yield devices


def test_captures_come_from_the_cameras_of_rig_toml(studio: StudioDevices, tmp_path: Path) -> None:
    rig_file = str(studio.folder / "rig.toml")
    with served_client(tmp_path / "data", worker=False, rig=rig_file) as (_, client):
        state = client.get("/v1/rig").json()
        assert (state["kind"], state["calibration"], len(state["cameras"])) == ("real", "own", 11)
        made = client.post("/v1/captures", json={"label": "first", "expression": "neutral"})
        assert made.status_code == 201, made.text
        capture = made.json()
        assert [camera["name"] for camera in capture["cameras"]] == list(NAMES)
        sync = sync_of(capture["shot"])
        assert all(sync[name]["status"] == "in sync" and sync[name]["skew_ms"] is not None for name in NAMES)
        assert [found["id"] for found in client.get("/v1/captures").json()["captures"]] == [capture["id"]]
        image = client.get(f"/v1/captures/{capture['id']}/images/cam05").content
        assert _decoded(image).shape == (240, 320, 3)
        state = client.get("/v1/rig").json()
        assert state["ready"]
        assert {camera["state"] for camera in state["cameras"]} == {"open"}
        assert _decoded(client.get("/v1/rig/cameras/cam03/preview.jpg").content).shape == (240, 320, 3)

        assert (capture["verdict"], capture["faults"]) == ("good", [])
        checks = client.get(f"/v1/captures/{capture['id']}/checks").json()["cameras"]
        assert all(check["blur_px"] < 2.5 and len(check["subject"]["outline"]) > 10 for check in checks.values())
        studio.inject(DeviceFault("unplugged"))
        failed = client.post("/v1/captures", json={})
        assert failed.status_code == 503
        assert any("trigger" in error for error in failed.json()["errors"])
        studio.clear()
        studio.seat(False)
        plates = client.post("/v1/rig/background").json()
        assert (plates["cameras"], plates["plates"]) == (list(NAMES), 5)
        studio.seat(True)
        in_use, before = client.get("/v1/rig/background").json()["versions"]
        assert (in_use["in_use"], before["in_use"], before["refused"]) == (True, False, [])
        refused = client.post("/v1/rig/background")  # with the sitter in them
        assert (refused.status_code, refused.json()["type"].endswith("plates-occupied")) == (409, True)
        assert len(refused.json()["errors"]) == len(NAMES)
        kept = client.get("/v1/rig/background").json()["versions"]
        assert [version["id"] for version in kept if version["in_use"]] == [in_use["id"]]
        assert client.post("/v1/captures", json={}).json()["verdict"] == "good", "the old plates are still in use"
        used = client.put("/v1/rig/background", json={"version": kept[0]["id"]}).json()["versions"]
        assert (used[0]["in_use"], len(used[0]["refused"])) == (True, len(NAMES))
        assert client.post("/v1/captures", json={}).json()["verdict"] == "poor", "nobody differs from themselves"
        assert client.put("/v1/rig/background", json={"version": in_use["id"]}).status_code == 200
        assert client.put("/v1/rig/background", json={"version": "../../secret"}).status_code == 404
        assert client.post("/v1/captures", json={}).status_code == 201
        assert client.post("/v1/captures", json={"seed": 1}).status_code == 422
        assert len(client.get("/v1/captures").json()["captures"]) == 4


def test_lamps_settings_and_a_moving_preview_over_http(studio: StudioDevices, tmp_path: Path) -> None:
    with served_client(tmp_path / "data", worker=False, rig=str(studio.folder / "rig.toml")) as (_, client):
        studio.seat(False)  # five takes in turn, each with noise of its own
        assert client.get("/v1/rig/lights").json() == {"outputs": [0, 1]}
        with client.stream("GET", "/v1/rig/cameras/cam03/preview.mjpg", params={"seconds": 1.6}) as stream:
            assert stream.headers["content-type"] == "multipart/x-mixed-replace; boundary=frame"
            data = stream.read()
        parts = [part for part in data.split(b"--frame\r\nContent-Type: image/jpeg\r\n") if part]
        pictures = [part.partition(b"\r\n\r\n")[2][: int(part.split()[1])] for part in parts]
        assert len(pictures) >= 3
        assert {_decoded(picture).shape for picture in pictures} == {(240, 320, 3)}
        assert len(set(pictures)) >= 2, "the sensor's noise makes each another picture"
        assert client.get("/v1/rig/cameras/cam99/preview.mjpg").status_code == 404
        assert client.put("/v1/rig/lights", json={"outputs": []}).json() == {"outputs": []}
        dark = _decoded(client.get("/v1/rig/cameras/cam03/preview.jpg").content)
        assert dark.mean() < 0.5 * _decoded(pictures[0]).mean()
        assert client.put("/v1/rig/lights", json={"outputs": [4]}).status_code == 422
        changed = client.patch("/v1/rig/cameras/cam03/settings", json={"exposure_ms": 8})
        assert changed.json()["exposure_ms"] == 8.0
        assert "exposure_ms" in changed.json()["unmet"][0]
        assert client.get("/v1/rig/cameras/cam03/settings").json() == changed.json()
        assert client.patch("/v1/rig/cameras/cam03/settings", json={"exposure_ms": -1}).status_code == 422


def test_the_live_view_takes_all_pictures_in_one_look(studio: StudioDevices, tmp_path: Path) -> None:
    rig = open_rig(ServiceSettings(data=tmp_path / "data", rig=studio.folder / "rig.toml"))
    try:
        child = Child()
        rounds = [rig_frames(rig, child, look) for look in (1, 2)]
        for frames in rounds:
            assert [frame["name"] for frame in frames] == list(NAMES)
            assert {_decoded(frame["jpeg"] or b"").shape for frame in frames} == {(240, 320, 3)}
        judged = [[frame["name"] for frame in frames if "blur_px" in frame] for frames in rounds]
        assert judged == [["cam01"], ["cam02"]], "each look judges another camera"
        studio.inject(DeviceFault("hung", "cam04"))
        deadline = time.monotonic() + 20
        while "fault" not in (lost := {frame["name"]: frame for frame in rig_frames(rig, child, 3)}["cam04"]):
            assert time.monotonic() < deadline
        assert lost["jpeg"] is None
    finally:
        rig.close()


def _decoded(data: bytes) -> np.ndarray:
    picture = cv2.imdecode(np.frombuffer(data, np.uint8), cv2.IMREAD_COLOR)
    assert picture is not None
    return picture
