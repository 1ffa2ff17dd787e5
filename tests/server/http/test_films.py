"""Films in the service: a few small frames of a head in the studio, uploaded, tracked by a job, and erased."""

import io
import json
import os
import signal
import tarfile
from collections.abc import Iterator
from dataclasses import replace
from pathlib import Path

import httpx
import numpy as np
import pytest

from pipeline.head_model.model import load_model
from rig.formats.captures.archive import pack_folder
from rig.formats.pictures.work_size import work_rig
from rig.render.renderer import Renderer
from rig.studio.scene.layout import default_layout
from server.cli.client import Client
from server.tasks.film import CHUNKS
from server.tasks.moving_subject import Person, simulate_sequence
from tests.support.services import (
    RunningService,
    await_state,
    await_true,
    awaited,
    running_service,
    stored,
    upload,
    worker_pids,
)
from tests.support.small_studio import CLEAN

CAMERAS, PIXELS = ["cam00", "cam01", "cam03", "cam04", "cam07"], 320 * 240
RESULT = ["person.npz", "preview.mp4", "report.json", "sequence.glb", "sequence.npz"]


def filmed(folder: Path, frames: int, renderer: Renderer) -> Path:
    """A film of a head that turns and speaks."""
    model = load_model()
    person = Person(model, 0.8 * np.random.default_rng(4).standard_normal(len(model.modes)), 3)
    rig, preset = work_rig(default_layout().subset(CAMERAS), PIXELS), replace(CLEAN, noise=0.005, plates=2)
    simulate_sequence(folder, person, rig, preset, frames, renderer=renderer, report=lambda stage, share: None)
    return folder


def packed_film(folder: Path) -> bytes:
    pack_folder(folder, folder.with_suffix(".tar"))
    return folder.with_suffix(".tar").read_bytes()


@pytest.fixture(scope="module")
def film(renderer: Renderer, tmp_path_factory: pytest.TempPathFactory) -> Path:
    return filmed(tmp_path_factory.mktemp("film") / "anna", 3, renderer)


@pytest.fixture
def stored_film(http: httpx.Client, film: Path) -> str:
    """The id of the film in the service."""
    return upload(http, packed_film(film), label="Anna speaks").json()["id"]


def test_a_film_is_uploaded_tracked_and_erased(
    service: RunningService, client: Client, http: httpx.Client, stored_film: str
) -> None:
    record = http.get(f"/v1/captures/{stored_film}").json()
    assert (record["kind"], record["frames"], record["verdict"], record["board"]) == ("film", 3, None, False)
    assert [camera["name"] for camera in record["cameras"]] == CAMERAS
    assert record["inputs"].keys() >= {"cameras.json", "times.csv", "images/cam07/00002.png", "background/cam00/000.png"}
    picture = http.get(f"/v1/captures/{stored_film}/images/cam07")
    assert picture.headers["etag"].strip('"') == record["inputs"]["images/cam07/00000.png"]

    job = http.post("/v1/jobs", json={"capture_id": stored_film}).json()
    assert (job["frames"], job["frames_done"]) == (3, None)
    said = [document for _, document in client.events(job["id"])]
    done = await_state(http, job["id"], ("succeeded", "failed"), 600.0)
    assert (done["state"], done["frames_done"], sorted(done["files"])) == ("succeeded", 3, RESULT)
    counted = [each["frames_done"] for each in said if each.get("stage") in ("frames", "preview")]
    assert counted == sorted(counted)
    assert {0, 3} <= {*counted}
    shares = [each["progress"] for each in said if "progress" in each]
    assert shares == sorted(shares)
    with np.load(io.BytesIO(http.get(f"/v1/jobs/{job['id']}/result/sequence.npz").content)) as found:
        assert found["frames"].tolist() == ["00000", "00001", "00002"]
        assert not found["failed"].any()
    assert http.get(f"/v1/jobs/{job['id']}/result/report.json").json()["frames"] == 3
    assert not [name for name in stored(service) if CHUNKS in name]
    exported = http.post(f"/v1/jobs/{job['id']}/exports", json={"as": "obj"})
    assert exported.status_code == 422, exported.text
    print(exported.text)

    assert http.delete(f"/v1/captures/{stored_film}", params={"erase": True}).status_code == 204
    assert http.get(f"/v1/jobs/{job['id']}").status_code == 404
    assert not [name for name in stored(service) if stored_film in name or job["id"] in name]
