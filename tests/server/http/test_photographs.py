"""Uploads of photographs alone, over HTTP: calibrated at the door, told as on the command line, or refused by name."""

import json
import shutil
from pathlib import Path

import httpx
import numpy as np
import pytest

from rig.formats.pictures.images import write_image
from tests.support.services import await_state, packed, upload
from tests.support.textured_wedge import HEIGHT, TAG_MM, WIDTH, wedge_rig, write_photographs


@pytest.mark.slow
def test_noise_is_refused_with_every_view_and_what_to_add(http: httpx.Client, tmp_path: Path) -> None:
    rng = np.random.default_rng(0)
    for index in range(3):
        write_image(tmp_path / "noise" / f"view{index}.png", rng.integers(0, 255, (120, 160), dtype=np.uint8))
    refused = upload(http, packed(tmp_path / "noise"))
    assert refused.status_code == 422
    errors = refused.json()["errors"]
    assert any("photographs alone do not determine the cameras" in error for error in errors)
    for index in range(3):
        assert any(f"view{index}: the view has only" in error and "light and focus it" in error for error in errors)


@pytest.mark.slow
def test_the_cameras_of_photographs_are_found_and_what_was_assumed_is_told(http: httpx.Client, tmp_path: Path) -> None:
    """One of the pictures is dark: it is left out, with its mask, and the capture holds the others."""
    photos = tmp_path / "photos"
    write_photographs(photos / "images", wedge_rig())
    write_image(photos / "images" / "dark.png", np.full((HEIGHT, WIDTH), 20, np.uint8))
    mask = np.zeros((HEIGHT, WIDTH), np.uint8)
    mask[20:-20, 20:-20] = 255
    for name in (*wedge_rig().names, "dark"):
        write_image(photos / "masks" / f"{name}.png", mask)
    made = upload(http, packed(photos))
    assert made.status_code == 201, made.text
    capture = made.json()
    assert [camera["name"] for camera in capture["cameras"]] == list(wedge_rig().names)
    assert {"cameras.json", "calibration.json", "masks/cam00.png"} <= capture["inputs"].keys()
    assert not [name for name in capture["inputs"] if "dark" in name]
    assert [warning["code"] for warning in capture["warnings"]] == ["view-left-out", "scale-assumed", "face-nowhere"]
    assert "dark: the view has only 0 distinct points" in capture["warnings"][0]["message"]
    assert "ASSUMPTION" in capture["warnings"][1]["message"]
    assert http.get(f"/v1/captures/{capture['id']}").json()["warnings"] == capture["warnings"]
    assert await_state(http, http.post("/v1/jobs", json={"capture_id": capture["id"]}).json()["id"], ("succeeded",))

    assert http.get(f"/v1/captures/{capture['id']}/images/cam00").status_code == 200
    for path in [*(photos / "images").iterdir()]:  # beside scale.json
        path.rename(photos / path.name)
    (photos / "images").rmdir()
    (photos / "dark.png").unlink()
    shutil.rmtree(photos / "masks")
    (photos / "scale.json").write_text(json.dumps({"tag": {"dictionary": "DICT_4X4_50", "size_mm": TAG_MM}}))
    known = upload(http, packed(photos)).json()
    assert [warning["code"] for warning in known["warnings"]] == ["face-nowhere"]  # a wedge; nothing was assumed
    assert "images/cam00.png" in known["inputs"]
    assert http.get(f"/v1/captures/{known['id']}/images/cam00").status_code == 200
