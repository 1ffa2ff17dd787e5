"""Jobs over HTTP, against a running service: results, events, progress, cancelling, failures."""

import io
import time
import zipfile
from itertools import pairwise

import httpx
import pytest

from server.cli.client import Client, JobEnded
from tests.support.services import RunningService, await_state, await_true, upload


def test_an_upload_becomes_a_capture_and_a_job_a_result(http: httpx.Client, archive: bytes) -> None:
    response = upload(http, archive, label="Anna", expression="neutral")
    assert response.status_code == 201
    capture = response.json()
    assert http.get(response.headers["location"]).json() == capture
    assert [camera["name"] for camera in capture["cameras"]] == ["cam00", "cam01", "cam02"]
    assert (capture["label"], capture["expression"]) == ("Anna", "neutral")
    response = http.post("/v1/jobs", json={"capture_id": capture["id"]})
    assert response.status_code == 202
    job = await_state(http, response.json()["id"], ("succeeded", "failed"))
    assert response.headers["location"] == f"/v1/jobs/{job['id']}"
    assert job["state"] == "succeeded"
    assert job["progress"] == 1.0
    assert set(job["files"]) == {"head.ply", "head.glb", "overlays/cam00.png"}
    whole = http.get(f"/v1/jobs/{job['id']}/result/head.ply")
    assert whole.status_code == 200
    assert whole.headers["etag"] == f'"{job["files"]["head.ply"]["sha256"]}"'
    part = http.get(f"/v1/jobs/{job['id']}/result/head.ply", headers={"Range": "bytes=100-199"})
    assert (part.status_code, part.content) == (206, whole.content[100:200])
    beyond = http.get(f"/v1/jobs/{job['id']}/result/head.ply", headers={"Range": "bytes=999999999-"})
    assert (beyond.status_code, beyond.headers["content-type"]) == (416, "application/problem+json")
    same = http.get(f"/v1/jobs/{job['id']}/result/head.ply", headers={"If-None-Match": whole.headers["etag"]})
    assert (same.status_code, same.content) == (304, b"")
    assert http.get(f"/v1/jobs/{job['id']}/result/overlays/cam00.png").status_code == 200
    missing = http.get(f"/v1/jobs/{job['id']}/result/nothing.ply")
    assert missing.status_code == 404
    assert f"GET /v1/jobs/{job['id']}/result lists" in missing.json()["detail"]
    listed = {file["name"]: file for file in http.get(f"/v1/jobs/{job['id']}/result").json()["files"]}
    assert set(listed) == set(job["files"])
    for file in listed.values():
        head, body = http.head(file["url"]), http.get(file["url"])
        assert (head.status_code, head.content) == (200, b"")
        assert head.headers["etag"] == body.headers["etag"] == f'"{file["sha256"]}"'
        assert int(head.headers["content-length"]) == len(body.content) == file["bytes"]
        assert head.headers["content-type"] == file["media_type"]
    packed = http.get(f"/v1/jobs/{job['id']}/result/all.zip")
    assert packed.headers["content-type"] == "application/zip"
    assert packed.content == http.get(f"/v1/jobs/{job['id']}/result/all.zip").content
    head = http.head(f"/v1/jobs/{job['id']}/result/all.zip")
    assert (head.status_code, head.headers["etag"], head.content) == (200, packed.headers["etag"], b"")
    assert "content-length" not in head.headers, "nobody knows it before the archive is made"
    with zipfile.ZipFile(io.BytesIO(packed.content)) as zipped:
        assert zipped.testzip() is None
        assert {name: len(zipped.read(name)) for name in zipped.namelist()} == {
            n: f["bytes"] for n, f in listed.items()
        }
    for form, template, word in (("obj", None, "report.json"), ("fbx", None, "3mf"), ("obj", "nobodys", "add FILE")):
        refused = http.post(f"/v1/jobs/{job['id']}/exports", json={"as": form, "template": template})
        assert (refused.status_code, word in refused.text) == (422, True), "the work of these tests writes no report"
    condition = {"If-None-Match": f'"another", W/{packed.headers["etag"]}'}  # as a proxy that compresses sends it
    assert http.get(f"/v1/jobs/{job['id']}/result/all.zip", headers=condition).status_code == 304
    assert http.get(f"/v1/captures/{capture['id']}/images/cam01").headers["content-type"] == "image/png"
    assert http.get(f"/v1/captures/{capture['id']}/images/cam99").status_code == 404


def test_a_job_says_that_nobody_serves_its_queue(http: httpx.Client, capture: str) -> None:
    job = http.post("/v1/jobs", json={"capture_id": capture, "queue": "gpu"}).json()
    assert job["notice"] == "No worker serves the queue 'gpu': start one with `eigenhead worker --queue gpu`."
    assert http.get(f"/v1/jobs/{job['id']}").json()["notice"] == job["notice"]
    assert http.post(f"/v1/jobs/{job['id']}/cancel").json()["notice"] is None
    served = await_state(http, http.post("/v1/jobs", json={"capture_id": capture}).json()["id"], ("succeeded",))
    assert served["notice"] is None


def test_an_idempotency_key_makes_one_job(http: httpx.Client, archive: bytes) -> None:
    capture, headers = upload(http, archive).json()["id"], {"Idempotency-Key": "once"}
    jobs = [http.post("/v1/jobs", json={"capture_id": capture}, headers=headers).json()["id"] for _ in range(3)]
    assert len(set(jobs)) == 1
    other = http.post("/v1/jobs", json={"capture_id": capture, "settings": {"method": "simplex"}}, headers=headers)
    assert other.status_code == 409


def test_an_upload_sent_again_with_its_key_makes_one_job_and_one_capture(http: httpx.Client, archive: bytes) -> None:
    def send(data: bytes = archive, key: str = "again", **fields: str) -> httpx.Response:
        files = {"file": ("shot.zip", data)}
        return http.post("/v1/reconstructions", files=files, data=fields, headers={"Idempotency-Key": key})

    first, captures = send(), len(http.get("/v1/captures").json()["captures"])
    again = send()
    assert (first.status_code, again.status_code) == (202, 202)
    assert again.json()["id"] == first.json()["id"]
    assert len(http.get("/v1/captures").json()["captures"]) == captures
    assert send(settings='{"method": "simplex"}').status_code == 409
    assert send(key="x" * 201).status_code == 422


def test_the_events_of_a_job_name_a_camera_that_has_moved(http: httpx.Client, client: Client, capture: str) -> None:
    for front, expected in (("moved", [["cam02 has moved by 5.0 px"]]), ("cam00", [])):
        job = client.submit(capture, settings={"front": front})["id"]
        assert [
            document["camera_moved"] for _, document in client.events(job) if "camera_moved" in document
        ] == expected


def test_events_tell_progress_and_resume(http: httpx.Client, client: Client, capture: str) -> None:
    job = client.submit(capture)["id"]
    seen = list(client.events(job))
    assert [kind for kind, _ in seen][-1] == "end"
    assert seen[-1][1]["state"] == "succeeded"
    progress = [document["progress"] for _, document in seen if "stage" in document and "progress" in document]
    assert progress == sorted(progress)
    with http.stream("GET", f"/v1/jobs/{job}/events", headers={"Last-Event-ID": "1"}) as response:
        ids = [line for line in response.iter_lines() if line.startswith("id:")]
    assert ids[0] == "id: 2"


def test_a_stage_that_reports_nothing_still_moves(http: httpx.Client, client: Client, archive: bytes) -> None:
    job = client.submit(upload(http, archive).json()["id"], settings={"front": "quiet"})["id"]
    events = [document for _, document in client.events(job) if document.get("stage") == "depth"]
    assert len(events) >= 2
    shares = [document["progress"] for document in events]
    assert all(0 <= earlier < later < earlier + 0.5 for earlier, later in pairwise(shares))
    assert all(document["eta_s"] > 0 for document in events)


@pytest.mark.parametrize("mode", ["long", "deaf"])
def test_a_cancelled_job_stops_its_work(service: RunningService, http: httpx.Client, capture: str, mode: str) -> None:
    """``deaf`` work never looks whether it should stop; its process is killed."""
    job = http.post("/v1/jobs", json={"capture_id": capture, "settings": {"front": mode}}).json()["id"]
    folder = service.data / "jobs" / job
    await_true(lambda: any(folder.glob("attempt-*")))  # running alone may be before the work
    cancelled = http.post(f"/v1/jobs/{job}/cancel").json()
    assert cancelled["state"] == "cancelled"
    await_true(lambda: not any(folder.glob("attempt-*")), 60.0)  # the work would take two minutes
    time.sleep(0.3)
    assert http.get(f"/v1/jobs/{job}").json()["state"] == "cancelled"
    assert http.get(f"/v1/jobs/{job}/log").text.splitlines()[-1].endswith("info job cancelled")
    assert "Traceback" not in service.log.read_text()
    again = http.post(f"/v1/jobs/{job}/restart", json={"settings": {"method": "simplex"}})
    assert (again.status_code, again.json()["restart_of"]) == (202, job)
    assert await_state(http, again.json()["id"], ("succeeded",))["settings"] == {"method": "simplex"}


@pytest.mark.parametrize(
    ("mode", "kind", "word"),
    [
        ("fail", "invalid-capture", "2 faults"),
        ("crash", "work-crashed", "signal 11"),
        ("bug", "internal-error", "planted"),
        ("killed", "out-of-memory", "memory"),
    ],
)
def test_a_failed_job_says_why_leaves_nothing_and_the_next_one_works(
    client: Client, service: RunningService, capture: str, mode: str, kind: str, word: str
) -> None:
    with pytest.raises(JobEnded) as caught:
        client.wait(client.submit(capture, settings={"front": mode})["id"])
    error = caught.value.job["error"]
    assert error is not None
    assert error["type"].endswith(kind)
    assert word in error["detail"]
    assert error["detail_message"]["message"] == error["detail"]
    assert not [*(service.data / "jobs" / caught.value.job["id"]).glob("attempt-*")]
    assert client.wait(client.submit(capture)["id"])["state"] == "succeeded"
