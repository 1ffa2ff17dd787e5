"""The service over HTTP: what it says of itself, and of requests that make no sense."""

import socket
from pathlib import Path
from types import SimpleNamespace

import httpx
import pytest

from server.services import health
from server.settings import ServiceSettings
from server.storage.database import open_database
from tests.support.services import RunningService, await_state, upload
from tests.support.template_headers import header_file


def test_requests_that_make_no_sense_are_4xx_problems(http: httpx.Client, capture: str) -> None:
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
    assert "accepts GET, POST, but not PUT" in http.put("/v1/jobs").json()["detail"]
    misplaced = http.post("/v1/captures", files={"file": b"x"})
    assert (misplaced.status_code, "POST /v1/captures/uploads" in misplaced.json()["detail"]) == (415, True)
    form = http.post("/v1/captures", data={"label": "x"})
    assert form.json()["errors"] == ["body: the request is no JSON object; send one, as application/json"]
    cut = http.patch("/v1/captures/x", content=b'{"label": ', headers={"content-type": "application/json"})
    assert "is no JSON" in cut.json()["errors"][0]


def test_text_that_no_database_keeps_is_refused_wherever_it_comes_in(http: httpx.Client, archive: bytes) -> None:
    capture = upload(http, archive).json()["id"]
    sessions = http.get("/v1/sessions").json()["total"]
    for answer in (
        http.post("/v1/sessions", json={"label": "a\0b"}),
        http.post("/v1/captures/uploads", files={"file": archive}, data={"label": "a\0b"}),
        http.patch(f"/v1/captures/{capture}", json={"expression": "a\0b"}),
        http.post("/v1/jobs", json={"capture_id": capture, "name": "a\0b"}),
        http.post("/v1/keys", json={"name": "a\0b", "scopes": ["read"]}),
        http.post("/v1/webhooks", json={"url": "https://a\0b"}),
        http.get("/v1/jobs", params={"q": "\0"}),
        http.get("/v1/jobs", params={"session": "\0"}),
        http.get("/v1/captures", params={"tag": "\0"}),
        http.get("/v1/captures", params={"before": "\0"}),
    ):
        assert answer.status_code == 422, answer.text
    assert http.get("/v1/sessions").json()["total"] == sessions
    assert http.get(f"/v1/captures/{capture}").json()["expression"] == ""


@pytest.mark.parametrize(
    "settings",
    [
        r'{"front": "\ud800"}',
        r'{"\ud800": 1}',
        r'{"outputs": {"\ud800": 1}}',
        f'{{"bust": {{"spacing_mm": {"9" * 400}}}}}',
        f'{{"front": {"[" * 500 + "]" * 500}}}',
    ],
)
def test_settings_that_no_answer_could_repeat_make_no_job(http: httpx.Client, capture: str, settings: str) -> None:
    body = f'{{"capture_id": "{capture}", "settings": {settings}}}'
    assert http.post("/v1/jobs", content=body, headers={"Content-Type": "application/json"}).status_code == 422
    assert http.get("/v1/jobs", params={"capture": capture}).json()["jobs"] == []


def test_an_upload_of_what_is_announced_too_large_is_refused_unread(service: RunningService) -> None:
    head = f"POST /v1/captures/uploads HTTP/1.1\r\nHost: 127.0.0.1\r\nContent-Length: {1 << 50}\r\n\r\n"
    with socket.create_connection(("127.0.0.1", service.port), timeout=10) as connection:
        connection.sendall(head.encode())
        assert connection.recv(100).startswith(b"HTTP/1.1 413")


def test_health_metrics_models_and_the_page_of_the_api(http: httpx.Client) -> None:
    assert http.get("/healthz").json()["status"] == "ok"
    ready = http.get("/readyz")
    assert (http.head("/healthz").status_code, http.head("/readyz").status_code) == (200, ready.status_code)
    assert {"egl", "disk", "database", "rig", "worker"} <= set(ready.json()["checks"])
    assert "eigenhead_requests_total" in http.get("/metrics").text
    assert any(model["default"] for model in http.get("/v1/models").json()["models"])
    assert "openapi.json" in http.get("/docs").text
    assert http.get("/openapi.json").json()["paths"]["/v1/jobs"]["post"]["operationId"] == "submit_job"


def test_templates_are_listed_and_a_job_may_name_those_of_its_model(
    service: RunningService, http: httpx.Client, archive: bytes
) -> None:
    assert http.get("/v1/templates").json() == {"templates": []}
    mine = header_file(service.data, "mine")
    other = header_file(service.data, "other", model_name="other", model_sha256="ee" * 32)
    wrong = header_file(service.data, "wrong")
    wrong.write_bytes(b"PK")
    try:
        first, second, damaged = http.get("/v1/templates").json()["templates"]
        assert (first["id"], first["vertices"], first["registration"]["off_p95_mm"]) == ("mine", 5023, 0.094)
        assert (first["model"], first["models"]) == ("makehuman-138", ["default", "makehuman-138"])
        assert (second["model"], second["models"], second["fault"]) == ("other", [], None)
        assert (damaged["model"], damaged["models"], damaged["registration"]) == (None, [], None)
        assert str(service.data) not in damaged["fault"]
        wanted = {"capture_id": upload(http, archive).json()["id"], "settings": {"outputs": {"template": "mine"}}}
        assert http.post("/v1/jobs", json=wanted).status_code == 202
        wanted["settings"] = {"outputs": {"template": "other", "formats": ["xyz"]}}
        refused = http.post("/v1/jobs", json=wanted)
        assert (refused.status_code, refused.headers["content-type"]) == (422, "application/problem+json")
        text = " | ".join(refused.json()["errors"])
        assert "'xyz' is none of" in text
        assert "'other' was registered to the model 'other'" in text
    finally:
        for template in (mine, other, wrong):
            template.unlink()


def test_a_worker_that_loads_is_no_fault(tmp_path: Path) -> None:
    engine = open_database(ServiceSettings(data=tmp_path))
    jobs = SimpleNamespace(worker_may_start=lambda: True)
    service = SimpleNamespace(engine=engine, settings=ServiceSettings(data=tmp_path), jobs=jobs)
    early = health._workers(service)  # type: ignore[arg-type]
    assert (early.ok, early.starting, "is starting" in early.detail.text) == (False, True, True)
    jobs.worker_may_start = lambda: False
    late = health._workers(service)  # type: ignore[arg-type]
    assert (late.ok, late.starting) == (False, False)
    assert "eigenhead worker" in late.detail.text
    engine.dispose()


def test_info_tells_limits_waiting_jobs_and_default_settings(http: httpx.Client, capture: str) -> None:
    info = http.get("/v1/info").json()
    assert info["version"] == http.get("/healthz").json()["version"]
    assert (info["cameras_least"], info["cameras_most"], info["jobs_per_key_most"]) == (3, 64, 200)
    job = http.post("/v1/jobs", json={"capture_id": capture, "settings": info["settings"]}).json()["id"]
    busy = http.get("/v1/info").json()
    assert busy["queued"] + busy["running"] >= 1
    assert await_state(http, job, ("succeeded", "failed"))["state"] == "succeeded"
    assert await_state(http, job, ("succeeded",))["settings"] == info["settings"]
