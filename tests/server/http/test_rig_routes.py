"""The simulated rig over HTTP."""

from pathlib import Path

import cv2
import numpy as np
import pytest

from tests.support.services import served_client


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
