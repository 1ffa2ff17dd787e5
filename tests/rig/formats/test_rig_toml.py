"""rig.toml: the example is read, and every wrong file is refused with what to do."""

import dataclasses
import tomllib
from pathlib import Path
from typing import Any

import pytest

from rig.errors import InputError
from rig.formats.rig_toml import (
    CameraConfig,
    LightsConfig,
    RigConfig,
    ShotConfig,
    TriggerConfig,
    read_rig_config,
    rig_config_from_document,
)

EXAMPLE = Path(__file__).resolve().parents[3] / "deploy" / "rig.example.toml"


def document(**changes: Any) -> dict[str, Any]:
    camera = {"name": "cam00", "driver": "opencv", "identity": "http://127.0.0.1:8000/cam00.mjpeg"}
    return {"format": "eigenhead-rig/1", "cameras": [camera], **changes}


def faults_of(changed: dict[str, Any]) -> str:
    with pytest.raises(InputError) as caught:
        rig_config_from_document(changed, Path())
    return str(caught.value)


def test_example_describes_eleven_cameras_and_defaults_suffice() -> None:
    config = read_rig_config(EXAMPLE)
    assert config.names == tuple(f"cam{i:02}" for i in range(11))
    assert {camera.driver for camera in config.cameras} == {"genicam", "gphoto", "opencv"}
    assert config.calibration_file == EXAMPLE.parent / "cameras.json"
    assert config.lights.outputs == (0, 1)
    config = rig_config_from_document(document(), Path("/rigs"))
    assert config.cameras[0].trigger == "external"
    assert config.plates_folder == Path("/rigs/plates")
    assert config.calibration_file is None


def test_example_shows_every_key() -> None:
    written = tomllib.loads(EXAMPLE.read_text())
    of_cameras = {key for camera in written["cameras"] for key in camera}
    for kind, keys in (
        (RigConfig, set(written) | {"folder"}),
        (CameraConfig, of_cameras),
        (TriggerConfig, set(written["trigger"])),
        (LightsConfig, set(written["lights"])),
        (ShotConfig, set(written["shot"])),
    ):
        assert {field.name for field in dataclasses.fields(kind)} == keys


def test_unknown_keys_are_refused_with_the_nearest() -> None:
    changed = document(shot={"skew_most": 3.0}, triger={"port": "x"})
    changed["cameras"][0]["identty"] = "x"
    message = faults_of(changed)
    for key, near in (("shot.skew_most", "skew_most_ms"), ("triger", "trigger"), ("cameras.cam00.identty", "identity")):
        assert f"unknown key '{key}'; did you mean '{near}'?" in message


@pytest.mark.parametrize("identity", ["0", "11", "/dev/video0", "usb:001,004", "cam#2", " 3 "])
def test_a_camera_by_index_is_refused(identity: str) -> None:
    changed = document()
    changed["cameras"][0]["identity"] = identity
    assert "is an index" in faults_of(changed)


@pytest.mark.parametrize(
    "identity",
    ["40012345", "/dev/v4l/by-id/usb-046d_C920-video-index0", "rtsp://10.0.0.2/1", "Fake_1", "captures/a#cam00"],
)
def test_what_survives_a_reboot_is_accepted(identity: str) -> None:
    changed = document()
    changed["cameras"][0]["identity"] = identity
    assert rig_config_from_document(changed, Path()).cameras[0].identity == identity


@pytest.mark.parametrize("port", ["/dev/ttyUSB0", "/dev/ttyACM1", "COM3", "0"])
def test_a_trigger_port_by_index_is_refused(port: str) -> None:
    assert "/dev/serial/by-id" in faults_of(document(trigger={"port": port}))


@pytest.mark.parametrize(
    ("changes", "expected"),
    [
        ({"format": "eigenhead-rig/9"}, "format is 'eigenhead-rig/9'; expected 'eigenhead-rig/1'"),
        ({"cameras": []}, "add one [[cameras]] table"),
        ({"cameras": {}}, "cameras is {}; expected a list"),
        ({"cameras": [7]}, "cameras[0] is no object"),
        ({"front": "cam0"}, "did you mean 'cam00'?"),
        ({"lights": {"outputs": [5]}}, "5 is not an output"),
        ({"lights": {"keep_on": 1}}, "lights.keep_on is 1; expected true or false"),
        ({"shot": {"warm_up_frames": 0}}, "shot.warm_up_frames: 0 is not between 1 and 1000"),
        ({"shot": {"timeout_s": "2"}}, "shot.timeout_s is '2'; expected a finite number"),
        ({"trigger": {}}, "trigger.port: missing"),
        ({"trigger": {"port": "/dev/serial/by-id/x", "pulse_us": 0}}, "pulse_us: 0"),
        ({"lights": {"settle_s": -1.0}}, "lights.settle_s: -1.0 is not between 0 and 60"),
        ({"shot": {"timeout_s": float("nan")}}, "shot.timeout_s is nan; expected a finite number"),
        ({"shot": {"open_timeout_s": float("inf")}}, "shot.open_timeout_s is inf; expected a finite number"),
        ({"shot": {"timeout_s": 1e6}}, "shot.timeout_s: 1000000.0 is not between 0.001 and 600"),
        ({"shot": {"plates": 1_000_000_000}}, "shot.plates: 1000000000 is not between 1 and 32"),
        ({"trigger": {"port": "/dev/serial/by-id/box", "baud": 0}}, "trigger: baud: 0 is not between 300 and 4000000"),
    ],
)
def test_wrong_values_are_named(changes: dict[str, Any], expected: str) -> None:
    assert expected in faults_of(document(**changes))


@pytest.mark.parametrize(
    ("camera", "expected"),
    [
        ({"driver": "opencvv"}, "driver is 'opencvv'; expected 'opencv' or 'gphoto'"),
        ({"rotation_deg": 45}, "rotation_deg is 45; expected 0 or 90 or 180 or 270"),
        ({"rotation_deg": True}, "rotation_deg is True; expected 0 or 90"),
        ({"channel": 12}, "channel: 12"),
        ({"channel": 1}, "there is no [trigger] table"),
        ({"delay_us": -1}, "delay_us: -1"),
        ({"width": 1.5}, "width is 1.5; expected a whole number or null"),
        ({"name": "a/b"}, "name: "),
        ({"identity": ""}, "identity: empty"),
    ],
)
def test_wrong_cameras_are_named(camera: dict[str, Any], expected: str) -> None:
    changed = document()
    changed["cameras"][0] |= camera
    assert expected in faults_of(changed)


def test_every_fault_is_listed_and_doubles_are_found() -> None:
    camera = {"name": "a", "driver": "opencv", "identity": "http://h/1", "channel": 2}
    changed = document(cameras=[camera, dict(camera)], trigger={"port": "/dev/serial/by-id/x"})
    message = faults_of(changed)
    for what in ("name 'a'", "identity 'http://h/1'", "channel 2"):
        assert f"have the same {what}" in message


def test_files_that_are_no_rig(tmp_path: Path) -> None:
    with pytest.raises(InputError, match=r"start from deploy/rig\.example\.toml"):
        read_rig_config(tmp_path / "rig.toml")
    (tmp_path / "rig.toml").write_text("format = ")
    with pytest.raises(InputError, match="cannot be read as TOML"):
        read_rig_config(tmp_path / "rig.toml")
