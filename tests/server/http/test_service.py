"""The service over HTTP, as processes: captures, jobs, events, results, and what it says about bad input."""

import io
import json
import shutil
import socket
import tarfile
import time
import zipfile
from collections.abc import Iterator
from itertools import pairwise
from pathlib import Path

import httpx
import pytest

from rig.formats.archive import pack_folder
from server.cli.client import Client, JobEnded, ServiceError
from tests.support.services import RunningService, await_state, running_service, small_capture


@pytest.fixture(scope="module")
def service(tmp_path_factory: pytest.TempPathFactory) -> Iterator[RunningService]:
    with running_service(tmp_path_factory.mktemp("service") / "data") as running:
        yield running


@pytest.fixture
def http(service: RunningService) -> Iterator[httpx.Client]:
    with httpx.Client(base_url=service.url, timeout=30) as client:
        yield client


@pytest.fixture
def client(service: RunningService) -> Iterator[Client]:
    with Client(service.url) as client:
        yield client


@pytest.fixture
def archive(tmp_path: Path) -> bytes:
    return packed(small_capture(tmp_path / "capture"))


def packed(folder: Path) -> bytes:
    pack_folder(folder, folder.with_suffix(".tar"))
    return folder.with_suffix(".tar").read_bytes()


def stored(service: RunningService) -> list[str]:
    kinds = ("captures", "jobs", "incoming", "uploads", "trash", "set-aside")
    return sorted(p.relative_to(service.data).as_posix() for kind in kinds for p in (service.data / kind).rglob("*"))


def upload(http: httpx.Client, data: bytes, path: str = "/v1/captures/uploads", **fields: str) -> httpx.Response:
    return http.post(path, files={"file": ("capture.tar", data)}, data=fields)


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
    with zipfile.ZipFile(io.BytesIO(packed.content)) as zipped:
        assert zipped.testzip() is None
        assert {name: len(zipped.read(name)) for name in zipped.namelist()} == {
            n: f["bytes"] for n, f in listed.items()
        }
    asked = {"If-None-Match": packed.headers["etag"]}
    assert http.get(f"/v1/jobs/{job['id']}/result/all.zip", headers=asked).status_code == 304
    assert http.get(f"/v1/captures/{capture['id']}/images/cam01").headers["content-type"] == "image/png"
    assert http.get(f"/v1/captures/{capture['id']}/images/cam99").status_code == 404


def test_upload_and_job_in_one_call(http: httpx.Client, archive: bytes) -> None:
    response = upload(http, archive, "/v1/reconstructions", settings='{"method": "simplex"}')
    assert response.status_code == 202
    job = await_state(http, response.headers["location"].rsplit("/", 1)[1], ("succeeded",))
    assert job["settings"] == {"method": "simplex"}


@pytest.mark.parametrize(
    ("fault", "word"),
    [
        ("damaged", "damaged or cut off"),
        ("missing image", "images/cam01.png is missing"),
        ("nan", "cam02.camera_from_world.translation holds a value that is no finite number"),
        ("no cameras", "holds no cameras.json"),
        ("wrong size", "is 30 x 30 pixels, but its camera is 24 x 24"),
        ("truncated image", "images/cam00.png is damaged"),
    ],
)
def test_a_bad_capture_gets_422_by_name_and_leaves_nothing(
    service: RunningService, http: httpx.Client, tmp_path: Path, fault: str, word: str
) -> None:
    folder = small_capture(tmp_path / "capture")
    if fault == "missing image":
        (folder / "images" / "cam01.png").unlink()
    if fault == "nan":
        document = json.loads((folder / "cameras.json").read_text())
        document["cameras"][2]["camera_from_world"]["translation"][1] = float("nan")
        (folder / "cameras.json").write_text(json.dumps(document))
    if fault == "no cameras":
        (folder / "cameras.json").unlink()
    if fault == "wrong size":
        small_capture(tmp_path / "other", size=30)
        shutil.copy(tmp_path / "other" / "images" / "cam02.png", folder / "images")
    if fault == "truncated image":
        path = folder / "images" / "cam00.png"
        path.write_bytes(path.read_bytes()[:-300])
    data = packed(folder)
    before = stored(service)
    for path in ("/v1/captures/uploads", "/v1/reconstructions"):
        response = upload(http, data[:5000] if fault == "damaged" else data, path)
        assert response.status_code == 422
        assert response.headers["content-type"] == "application/problem+json"
        assert any(word in error for error in response.json()["errors"])
    assert stored(service) == before


def test_every_fault_is_listed(http: httpx.Client, tmp_path: Path) -> None:
    folder = small_capture(tmp_path / "capture")
    (folder / "images" / "cam00.png").unlink()
    (folder / "background" / "cam02.png").write_bytes(b"no picture")
    points = {"pronasale": {"cam07": [1, 2]}}
    (folder / "features.json").write_text(json.dumps({"format": "eigenhead-features/1", "points": points}))
    errors = upload(http, packed(folder)).json()["errors"]
    for word in ("images/cam00", "background/cam02", "cam07"):
        assert any(word in error for error in errors)


def test_requests_that_make_no_sense_are_4xx_problems(http: httpx.Client, archive: bytes) -> None:
    capture = upload(http, archive).json()["id"]
    wrong = [
        (http.get("/v1/captures/../../etc/passwd"), 404),
        (http.get("/v1/captures/" + "0" * 28), 404),
        (http.get("/v1/jobs/%2e%2e%2fx"), 404),
        (http.get(f"/v1/captures/{capture}/images/..%2frecord.json"), 404),
        (http.post("/v1/jobs", json={"capture_id": capture, "settings": {"metod": "simplex"}}), 422),
        (http.post("/v1/jobs", json={"capture_id": capture, "model": "../../etc/passwd"}), 422),
        (http.post("/v1/jobs", json={"capture_id": capture, "colour": 1}), 422),
        (http.post("/v1/jobs", content=b"{nan"), 422),
        (http.post("/v1/jobs", json={"capture_id": "0" * 28}), 404),
        (http.post("/v1/captures/uploads", content=b"x"), 415),
        (http.post("/v1/captures/uploads", data={"label": "x"}, files={"other": b"x"}), 422),
        (http.delete("/v1/healthz"), 404),
        (http.put("/v1/jobs"), 405),
    ]
    for response, status in wrong:
        assert response.status_code == status, response.text
        assert response.headers["content-type"] == "application/problem+json"
        assert response.json()["type"].startswith("urn:eigenhead:problem:")
        assert response.json()["detail"]


def test_a_bad_model_does_not_hide_bad_settings(http: httpx.Client, archive: bytes) -> None:
    capture = upload(http, archive).json()["id"]
    wanted = {"capture_id": capture, "model": "nobody", "settings": {"metod": "contour", "fitting": {"modes": "many"}}}
    refused = http.post("/v1/jobs", json=wanted)
    assert refused.status_code == 422
    told = " | ".join(refused.json()["errors"])
    assert all(word in told for word in ("'nobody' is not at hand", "metod", "fitting.modes")), told


def test_a_session_without_captures_is_asked_as_much(http: httpx.Client) -> None:
    session = http.post("/v1/sessions", json={}).json()["id"]
    refused = http.post(f"/v1/sessions/{session}/jobs", json={"settings": {"detial": "fine"}})
    assert (refused.status_code, "did you mean 'detail'" in refused.text) == (422, True)


def test_a_job_says_that_nobody_serves_its_queue(http: httpx.Client, archive: bytes) -> None:
    capture = upload(http, archive).json()["id"]
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


def test_the_events_of_a_job_name_a_camera_that_has_moved(http: httpx.Client, client: Client, archive: bytes) -> None:
    capture = upload(http, archive).json()["id"]
    for front, told in (("moved", [["cam02 has moved by 5.0 px"]]), ("cam00", [])):
        job = client.submit(capture, settings={"front": front})["id"]
        assert [document["camera_moved"] for _, document in client.events(job) if "camera_moved" in document] == told


def test_events_tell_progress_and_resume(http: httpx.Client, client: Client, archive: bytes) -> None:
    capture = upload(http, archive).json()["id"]
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
    told = [document for _, document in client.events(job) if document.get("stage") == "depth"]
    assert len(told) >= 3
    shares = [document["progress"] for document in told]
    assert all(0 <= earlier < later < earlier + 0.5 for earlier, later in pairwise(shares))
    assert all(document["eta_s"] > 0 for document in told)


@pytest.mark.parametrize("mode", ["long", "deaf"])
def test_a_cancelled_job_stops_within_a_second(
    service: RunningService, http: httpx.Client, archive: bytes, mode: str
) -> None:
    """``deaf`` work never looks whether it should stop; its process is killed."""
    capture = upload(http, archive).json()["id"]
    job = http.post("/v1/jobs", json={"capture_id": capture, "settings": {"front": mode}}).json()["id"]
    await_state(http, job, ("running", "succeeded"))
    cancelled = http.post(f"/v1/jobs/{job}/cancel").json()
    assert cancelled["state"] == "cancelled"
    folder = service.data / "jobs" / job
    began = time.monotonic()
    while any(folder.glob("attempt-*")):
        assert time.monotonic() - began < 1.5
        time.sleep(0.02)
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
    ],
)
def test_a_failed_job_says_why_and_the_next_one_works(
    client: Client, http: httpx.Client, archive: bytes, mode: str, kind: str, word: str
) -> None:
    capture = upload(http, archive).json()["id"]
    with pytest.raises(JobEnded) as caught:
        client.wait(client.submit(capture, settings={"front": mode})["id"])
    error = caught.value.job["error"]
    assert error is not None
    assert error["type"].endswith(kind)
    assert word in error["detail"]
    assert client.wait(client.submit(capture)["id"])["state"] == "succeeded"


def test_a_capture_in_use_is_not_removed_and_a_finished_job_is(http: httpx.Client, archive: bytes) -> None:
    capture = upload(http, archive).json()["id"]
    job = http.post("/v1/jobs", json={"capture_id": capture}).json()["id"]
    assert http.delete(f"/v1/captures/{capture}").status_code == 409
    assert http.delete(f"/v1/jobs/{job}").status_code in (204, 409)
    await_state(http, job, ("succeeded",))
    assert http.delete(f"/v1/captures/{capture}").status_code == 204
    assert http.get(f"/v1/captures/{capture}").status_code == 404
    assert http.get(f"/v1/jobs/{job}/result/head.ply").status_code == 200
    assert http.post(f"/v1/jobs/{job}/restart").status_code == 404
    assert http.delete(f"/v1/jobs/{job}").status_code == 204
    assert http.get(f"/v1/jobs/{job}").status_code == 404


def test_features_are_stored_or_refused_by_name(http: httpx.Client, archive: bytes) -> None:
    capture = upload(http, archive).json()["id"]
    points = {"pronasale": {"cam00": [3.0, 4.0], "cam01": [5.0, 6.0]}}
    assert http.put(f"/v1/captures/{capture}/features", json={"points": points}).json()["features"] is True
    assert http.get(f"/v1/captures/{capture}/features").json()["points"] == points
    wrong = {"pronasale": {"cam09": [1, 2], "cam00": [900, 2]}}
    bad = http.put(f"/v1/captures/{capture}/features", json={"points": wrong})
    assert bad.status_code == 422
    assert len(bad.json()["errors"]) == 2
    assert http.get(f"/v1/captures/{capture}/features").json()["points"] == points


def test_labels_and_sessions_can_be_put_right(http: httpx.Client, archive: bytes) -> None:
    session = http.post("/v1/sessions", json={"label": "Anna"}).json()["id"]
    capture = upload(http, archive, label="first").json()["id"]
    moved = http.patch(f"/v1/captures/{capture}", json={"session": session, "expression": "smile"}).json()
    assert (moved["session"], moved["label"], moved["expression"]) == (session, "first", "smile")
    assert http.get(f"/v1/sessions/{session}").json()["captures"] == [capture]
    renamed = http.patch(f"/v1/sessions/{session}", json={"consent": "signed"}).json()
    assert (renamed["label"], renamed["consent"], renamed["captures"]) == ("Anna", "signed", [capture])
    assert http.patch(f"/v1/captures/{capture}", json={"session": "0" * 28}).status_code == 404
    assert http.patch(f"/v1/captures/{capture}", json={"name": "x"}).status_code == 422
    alone = http.patch(f"/v1/captures/{capture}", json={"session": None}).json()
    assert (alone["session"], alone["expression"]) == (None, "smile")


def test_erasing_a_session_leaves_nothing_of_it(service: RunningService, http: httpx.Client, archive: bytes) -> None:
    session = http.post("/v1/sessions", json={"label": "Subject 7", "consent": "signed 2024-05-01"}).json()["id"]
    captures = [upload(http, archive, session=session, label="zebra").json()["id"] for _ in range(2)]
    jobs = [job["id"] for job in http.post(f"/v1/sessions/{session}/jobs", json={}).json()["jobs"]]
    assert len(jobs) == 2
    await_state(http, jobs[0], ("running", "succeeded"))
    assert http.get(f"/v1/sessions/{session}").json()["captures"] == sorted(captures, reverse=True)
    for capture in captures:
        (service.data / "cache/captures" / capture / "small").mkdir(parents=True)
        (service.data / "cache/captures" / capture / "small/cam00.jpg").write_bytes(b"a face")
    assert http.delete(f"/v1/sessions/{session}").status_code == 204
    gone = [session, *captures, *jobs]
    assert not [path for path in stored(service) if any(identity in path for identity in gone)]
    for kind, ids in (("sessions", [session]), ("captures", captures), ("jobs", jobs)):
        assert [http.get(f"/v1/{kind}/{identity}").status_code for identity in ids] == [404] * len(ids)
    database = b"".join(path.read_bytes() for path in service.data.glob("eigenhead.sqlite*"))
    assert b"Subject 7" not in database


def test_a_resumable_upload_goes_on_after_a_break(http: httpx.Client, archive: bytes) -> None:
    tus = {"Tus-Resumable": "1.0.0"}
    created = http.post("/v1/uploads", headers=tus | {"Upload-Length": str(len(archive))})
    assert created.status_code == 201
    where, part = created.headers["location"], tus | {"Content-Type": "application/offset+octet-stream"}
    first = http.patch(where, content=archive[:7000], headers=part | {"Upload-Offset": "0"})
    assert (first.status_code, first.headers["upload-offset"]) == (204, "7000")
    assert http.head(where, headers=tus).headers["upload-offset"] == "7000"
    assert http.patch(where, content=b"x", headers=part | {"Upload-Offset": "0"}).status_code == 409
    wrong = part | {"Upload-Offset": "7000", "Upload-Checksum": "sha256 AAAA"}
    assert http.patch(where, content=archive[7000:8000], headers=wrong).status_code == 460
    assert http.head(where, headers=tus).headers["upload-offset"] == "7000"
    last = http.patch(where, content=archive[7000:], headers=part | {"Upload-Offset": "7000"})
    assert last.status_code == 204
    assert http.get(last.headers["location"]).status_code == 200
    assert http.head(where, headers=tus).headers["location"] == last.headers["location"]


def test_a_resumable_upload_of_a_bad_capture_gets_422(
    service: RunningService, http: httpx.Client, archive: bytes
) -> None:
    before = stored(service)
    tus, data = {"Tus-Resumable": "1.0.0"}, archive[:5000]
    where = http.post("/v1/uploads", headers=tus | {"Upload-Length": str(len(data))}).headers["location"]
    part = tus | {"Content-Type": "application/offset+octet-stream", "Upload-Offset": "0"}
    response = http.patch(where, content=data, headers=part)
    assert response.status_code == 422
    assert "damaged" in response.json()["errors"][0]
    assert stored(service) == before


def test_the_client_uploads_folders_and_checks_downloads(client: Client, tmp_path: Path) -> None:
    session = client.post("/v1/sessions", {"label": "Ä"})["id"]
    capture = client.upload(small_capture(tmp_path / "capture"), session=session, label="links")
    assert (capture["session"], capture["label"]) == (session, "links")
    job = client.wait(client.submit(capture["id"])["id"])
    paths = client.download(job["id"], tmp_path / "out")
    assert sorted(path.relative_to(tmp_path / "out").as_posix() for path in paths) == sorted(job["files"])
    (tmp_path / "capture" / "images" / "cam00.png").unlink()
    with pytest.raises(ServiceError, match=r"images/cam00.png is missing") as caught:
        client.upload(tmp_path / "capture")
    assert caught.value.status == 422


def test_an_upload_of_what_is_announced_too_large_is_refused_unread(service: RunningService) -> None:
    head = f"POST /v1/captures/uploads HTTP/1.1\r\nHost: 127.0.0.1\r\nContent-Length: {1 << 50}\r\n\r\n"
    with socket.create_connection(("127.0.0.1", service.port), timeout=10) as connection:
        connection.sendall(head.encode())
        assert connection.recv(100).startswith(b"HTTP/1.1 413")


def test_foreign_pages_may_not_use_the_keyless_service(http: httpx.Client) -> None:
    assert http.get("/v1/jobs", headers={"Host": "evil.example"}).status_code == 403
    assert http.get("/v1/jobs", headers={"Origin": "http://evil.example"}).status_code == 403
    assert http.get("/v1/jobs", headers={"Origin": "http://localhost:3000"}).status_code == 200


def test_health_metrics_models(http: httpx.Client) -> None:
    assert http.get("/healthz").json()["status"] == "ok"
    ready = http.get("/readyz")
    assert {"egl", "disk", "database", "rig", "worker"} <= set(ready.json()["checks"])
    assert "eigenhead_requests_total" in http.get("/metrics").text
    assert any(model["default"] for model in http.get("/v1/models").json()["models"])


def test_info_tells_limits_waiting_jobs_and_default_settings(http: httpx.Client, archive: bytes) -> None:
    told = http.get("/v1/info").json()
    assert told["version"] == http.get("/healthz").json()["version"]
    assert (told["cameras_least"], told["cameras_most"], told["jobs_per_key_most"]) == (3, 64, 200)
    capture = upload(http, archive).json()["id"]
    job = http.post("/v1/jobs", json={"capture_id": capture, "settings": told["settings"]}).json()["id"]
    busy = http.get("/v1/info").json()
    assert busy["queued"] + busy["running"] >= 1
    assert await_state(http, job, ("succeeded", "failed"))["state"] == "succeeded"
    assert await_state(http, job, ("succeeded",))["settings"] == told["settings"]


def test_the_page_of_the_api_is_there(http: httpx.Client) -> None:
    assert "openapi.json" in http.get("/docs").text
    assert http.get("/openapi.json").json()["paths"]["/v1/jobs"]["post"]["operationId"] == "submit_job"


def test_a_tar_made_elsewhere_with_one_enclosing_folder_works(http: httpx.Client, tmp_path: Path) -> None:
    folder, buffer = small_capture(tmp_path / "capture"), io.BytesIO()
    with tarfile.open(fileobj=buffer, mode="w:gz") as archive:
        archive.add(folder, arcname="Anna")
    assert upload(http, buffer.getvalue()).status_code == 201
