"""Calibrations from photographs that show no board, over HTTP: what comes out, what is kept, what is refused."""

import json
from pathlib import Path

import httpx
import numpy as np
import pytest

from calibration.adjustment.gauge import image_distance
from rig.formats.cameras.cameras_json import rig_from_document
from rig.formats.pictures.images import write_image
from tests.support.services import RunningService, await_calibration, packed, small_capture, upload
from tests.support.textured_wedge import TAG_MM, wedge_rig, write_photographs


def test_what_is_no_scene_is_refused_by_name(http: httpx.Client, tmp_path: Path) -> None:
    sizes = {f"view{index}": (40, 30) for index in range(3)}
    for name, (width, height) in sizes.items():
        write_image(tmp_path / "photos" / f"{name}.png", np.zeros((height, width), np.uint8))
    (tmp_path / "photos" / "scale.json").write_text('{"cameras": ["view0", "nobody"], "distance_mm": 400}')
    scale = upload(http, packed(tmp_path / "photos"), "/v1/calibrations", **{"from": "scene"})
    assert (scale.status_code, scale.json()["errors"]) == (
        422,
        ["cameras names 'nobody', of which there is no photograph"],
    )
    (tmp_path / "photos" / "view2.png").unlink()
    few = upload(http, packed(tmp_path / "photos"), "/v1/calibrations", **{"from": "scene"})
    assert few.status_code == 422
    assert "2 photographs; at least 3" in few.json()["errors"][0]
    other = upload(http, packed(tmp_path / "photos"), "/v1/calibrations", **{"from": "mirror"})
    assert (other.status_code, other.json()["errors"]) == (422, ["from: 'mirror'"])
    assert upload(http, packed(tmp_path / "photos"), "/v1/calibrations").status_code == 422  # no board.toml
    misspelt = upload(http, packed(tmp_path / "photos"), "/v1/calibrations", lable="Monday")
    assert "did you mean 'label'" in misspelt.json()["errors"][0]
    for body in ({"from": "scene", "board": {}}, {"scale": {}, "board": {}}, {}, {"from": "scene", "captures": []}):
        assert http.post("/v1/calibrations", json={"captures": ["0" * 28]} | body).status_code == 422


@pytest.mark.slow
def test_pictures_of_a_scene_become_a_calibration(service: RunningService, http: httpx.Client, tmp_path: Path) -> None:
    write_photographs(tmp_path / "photos", wedge_rig())
    (tmp_path / "photos" / "scale.json").write_text(
        json.dumps({"tag": {"dictionary": "DICT_4X4_50", "size_mm": TAG_MM}})
    )
    made = upload(http, packed(tmp_path / "photos"), "/v1/calibrations", **{"from": "scene", "label": 600 * "w"})
    assert made.status_code == 202, made.text
    assert (made.json()["kind"], made.json()["pictures"]) == ("scene", dict.fromkeys(wedge_rig().names, 1))
    found = await_calibration(http, made.json()["id"])
    assert found["state"] == "succeeded", found["error"]
    assert (found["verdict"], found["warnings"], found["label"]) == ("usable", [], 500 * "w")
    assert all(missing.endswith("at the subject: add views near it") for missing in found["missing"])
    assert found["figures"]["rms_px"] < 0.3
    rig = rig_from_document(http.get(f"/v1/calibrations/{found['id']}/cameras.json").json())
    assert image_distance(rig, wedge_rig(), scale=True).max() < 0.1
    assert "Calibration from the scene" in http.get(f"/v1/calibrations/{found['id']}/report.html").text
    kept = {path.name for path in (service.data / "calibrations" / found["id"]).iterdir()}
    assert kept == {"record.json", "scale.json", "result"}, "photographs may show a subject"


@pytest.mark.slow
def test_shots_become_one_or_are_refused_with_the_views(
    service: RunningService, http: httpx.Client, tmp_path: Path
) -> None:
    """Of noise, in which nothing is found again; the capture's own pictures stay where they are."""
    capture = upload(http, packed(small_capture(tmp_path / "noise"))).json()["id"]
    made = http.post("/v1/calibrations", json={"from": "scene", "captures": [capture], "label": "noise"})
    assert made.status_code == 202, made.text
    found = await_calibration(http, made.json()["id"])
    assert (found["state"], found["source"], found["kind"]) == ("failed", "rig", "scene")
    assert any(error.startswith("cam00: the view has only") for error in found["error"]["errors"])
    assert not (service.data / "calibrations" / found["id"] / "images").exists()
    assert http.get(f"/v1/captures/{capture}/images/cam00").status_code == 200
