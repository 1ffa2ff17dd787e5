"""What a capture's pictures tell of the face, over HTTP: beside the verdict, which it leaves as it is."""

from pathlib import Path

import httpx

from tests.support.drawn_studio import drawn_studio, write_drawn_capture
from tests.support.services import packed, upload


def test_a_capture_says_who_lacks_the_face_and_where_it_looks(http: httpx.Client, tmp_path: Path) -> None:
    made = upload(http, packed(write_drawn_capture(tmp_path / "capture", left_deg=25.0, hidden=("cam3",))))
    assert made.status_code == 201, made.text
    capture = made.json()
    assert capture["verdict"] == "good"
    missing, turned = (remark for remark in capture["warnings"] if remark["code"].startswith("face-"))
    assert (missing["code"], missing["parameters"]) == ("face-missing", {"cameras": ["cam3"]})
    assert turned["code"] == "face-turned"
    assert turned["parameters"]["camera"] == "cam0"
    assert turned["parameters"]["way"]["code"] == "look-left"
    assert 20.0 < turned["parameters"]["way"]["parameters"]["angle_deg"] < 30.0
    assert http.get(f"/v1/captures/{capture['id']}").json()["warnings"] == capture["warnings"]


def test_pictures_without_a_face_have_one_line(http: httpx.Client, tmp_path: Path) -> None:
    wall = packed(write_drawn_capture(tmp_path / "wall", hidden=drawn_studio().names))
    codes = [warning["code"] for warning in upload(http, wall).json()["warnings"]]
    assert codes == ["pose-doubtful", "face-nowhere"]  # a wall has no outline, either


def test_an_empty_seat_has_its_fault_alone(http: httpx.Client, archive: bytes) -> None:
    capture = upload(http, archive).json()
    assert [fault["code"] for fault in capture["faults"]] == ["empty"]
    assert capture["warnings"] == []
