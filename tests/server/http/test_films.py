"""Films in the service: a few small frames of a head in the studio, uploaded, tracked by a job, and erased."""

import io
import shutil
from dataclasses import replace
from pathlib import Path

import httpx
import numpy as np
import pytest

from pipeline.applications.moments.footage import open_footage
from pipeline.applications.moments.sequence import CHUNK
from pipeline.head_model.model import load_model
from rig.errors import InputError
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
    kill_workers,
    packed,
    served_client,
    stored,
    upload,
)
from tests.support.small_studio import CLEAN

FRAMES = CHUNK + 3
CAMERAS, PIXELS = ["cam00", "cam01", "cam03", "cam04", "cam07"], 320 * 240
RESULT = ["person.npz", "preview.mp4", "report.json", "sequence.glb", "sequence.npz"]


@pytest.fixture(scope="module")
def film(renderer: Renderer, tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Three frames of a head that turns and speaks."""
    folder, model = tmp_path_factory.mktemp("film") / "anna", load_model()
    person = Person(model, 0.8 * np.random.default_rng(4).standard_normal(len(model.modes)), 3)
    rig, preset = work_rig(default_layout().subset(CAMERAS), PIXELS), replace(CLEAN, noise=0.005, plates=2)
    simulate_sequence(folder, person, rig, preset, 3, renderer=renderer, report=lambda stage, share: None)
    return folder


@pytest.fixture
def stored_film(http: httpx.Client, film: Path) -> str:
    """The id of the film in the service."""
    return upload(http, packed(film), label="Anna speaks").json()["id"]


def test_a_film_is_uploaded_tracked_and_erased(
    service: RunningService, client: Client, http: httpx.Client, stored_film: str
) -> None:
    record = http.get(f"/v1/captures/{stored_film}").json()
    assert (record["kind"], record["frames"], record["verdict"], record["board"]) == ("film", 3, None, False)
    assert [camera["name"] for camera in record["cameras"]] == CAMERAS
    assert record["inputs"].keys() >= {
        "cameras.json",
        "times.csv",
        "images/cam07/00002.png",
        "background/cam00/000.png",
    }
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
    assert (exported.status_code, exported.json()["detail_message"]["code"]) == (409, "film-export")

    assert http.delete(f"/v1/captures/{stored_film}", params={"erase": True}).status_code == 204
    assert http.get(f"/v1/jobs/{job['id']}").status_code == 404
    assert not [name for name in stored(service) if stored_film in name or job["id"] in name]


def test_a_film_with_faults_is_refused_in_the_words_of_the_command(
    http: httpx.Client, film: Path, tmp_path: Path
) -> None:
    spoilt = shutil.copytree(film, tmp_path / "anna")
    shutil.rmtree(spoilt / "images" / "cam07")
    for name in CAMERAS[:-1]:
        for number in (1, 2):
            (spoilt / "images" / name / f"{number:05}.png").rename(spoilt / "images" / name / f"{number}{name}.png")
    with pytest.raises(InputError) as of_command:
        open_footage(spoilt)
    refused = upload(http, packed(spoilt))
    assert (refused.status_code, refused.json()["type"]) == (422, "urn:eigenhead:problem:invalid-capture")
    assert refused.json()["errors"] == [fault.text for fault in of_command.value.faults]
    assert len(refused.json()["errors"]) == 1


def test_what_takes_single_shots_refuses_a_film_by_name(http: httpx.Client, stored_film: str) -> None:
    def code(path: str, document: dict, status: int, method: str = "POST") -> list[str]:
        answer = http.request(method, path, json=document)
        assert answer.status_code == status, answer.text
        said = answer.json()
        return [each["code"] for each in said["error_messages"]] or [said["detail_message"]["code"]]

    points = {"format": "eigenhead-features/1", "points": {}}
    assert code(f"/v1/captures/{stored_film}/features", points, 409, "PUT") == ["film-capture"]
    assert code("/v1/batches", {"captures": [stored_film]}, 422) == ["batch-capture-film"]
    wanted = {"capture_id": stored_film, "settings": {"detail": "fine", "usd": 1}}
    assert code("/v1/jobs", wanted, 422) == ["film-settings", "no-switch"]
    assert http.get("/v1/captures", params={"q": "Anna speaks"}).json()["captures"][0]["kind"] == "film"
    session = http.post("/v1/sessions", json={"label": "Anna"}).json()["id"]
    assert http.patch(f"/v1/captures/{stored_film}", json={"session": session}).status_code == 200
    assert http.post(f"/v1/sessions/{session}/jobs", json={}).json()["jobs"] == []


@pytest.mark.slow
@pytest.mark.timeout(1200)
def test_a_films_job_goes_on_from_its_chunks_when_its_worker_is_killed(film: Path, tmp_path: Path) -> None:
    long = shutil.copytree(film, tmp_path / "anna", ignore=shutil.ignore_patterns("times.csv"))
    for number in range(3, FRAMES):  # there and back, which costs no drawing
        for folder in (long / "images").iterdir():
            shutil.copy(folder / f"{(0, 1, 2, 1)[number % 4]:05}.png", folder / f"{number:05}.png")
    with served_client(tmp_path / "data") as (service, http):
        capture = upload(http, packed(long)).json()["id"]
        job = http.post("/v1/jobs", json={"capture_id": capture}).json()["id"]
        chunk = service.data / "jobs" / job / CHUNKS / "0000000.npz"
        await_true(chunk.is_file, 900.0)
        written = chunk.stat().st_mtime_ns
        kill_workers(service)
        again = awaited(lambda: http.get(f"/v1/jobs/{job}").json(), lambda found: found["frames_done"] == CHUNK, 300.0)
        assert (again["state"], chunk.stat().st_mtime_ns) == ("running", written)
        done = await_state(http, job, ("succeeded", "failed"), 600.0)
        assert sorted(done["files"]) == RESULT, done
        with np.load(io.BytesIO(http.get(f"/v1/jobs/{job}/result/sequence.npz").content)) as found:
            assert found["frames"].tolist() == [f"{number:05}" for number in range(FRAMES)]
            assert not found["failed"].any()
        assert "job taken over" in service.log.read_text()

        restarted = http.post(f"/v1/jobs/{job}/restart").json()["id"]
        chunks = service.data / "jobs" / restarted / CHUNKS
        await_true(chunks.is_dir, 300.0)
        http.post(f"/v1/jobs/{restarted}/cancel")
        await_true(lambda: not chunks.exists())
