"""API keys and scopes, the loopback rule, limits of a key, and webhooks that are signed and tried again."""

import base64
import hashlib
import hmac
import json
import socket
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import pytest

from server.services.keys import SCOPES
from tests.support.attacks import add_keys
from tests.support.attacks import client as client_for
from tests.support.loopback import hooked
from tests.support.services import (
    RunningService,
    await_state,
    await_true,
    packed,
    running_service,
    served_client,
    small_capture,
    upload,
)

Guarded = tuple[RunningService, dict[str, str]]


@pytest.fixture(scope="module")
def guarded(tmp_path_factory: pytest.TempPathFactory) -> Iterator[Guarded]:
    """A service with one key for each scope."""
    with running_service(tmp_path_factory.mktemp("guarded") / "data", jobs_per_key="3") as service:
        yield service, dict(zip(SCOPES, add_keys(service, *SCOPES), strict=True))


def test_each_scope_does_what_it_may_and_no_more(guarded: Guarded, tmp_path: Path) -> None:
    service, keys = guarded
    files = {"file": packed(small_capture(tmp_path / "capture"))}
    calls: dict[str, Any] = {
        "read": lambda client: client.get("/v1/jobs"),
        "capture": lambda client: client.post("/v1/captures/uploads", files=files),
        "submit": lambda client: client.post("/v1/jobs", json={"capture_id": "0" * 28}),
        "erase": lambda client: client.delete("/v1/sessions/" + "0" * 28),
        "admin": lambda client: client.get("/v1/keys"),
    }
    for holder, key in keys.items():
        with client_for(service, key) as client:
            for scope, call in calls.items():
                allowed = scope == holder or holder == "admin"
                assert (call(client).status_code != 403) == allowed, (holder, scope)
    for key in (None, "eh_000000000000_wrong", keys["read"][:-1] + "x", "nonsense"):
        with client_for(service, key) as client:
            for call in calls.values():
                refused = call(client)
                assert refused.status_code == 401
                assert refused.json()["type"].endswith("key-missing" if key is None else "key-invalid")
            assert client.get("/healthz").status_code == 200


def test_erasing_captures_with_their_heads_needs_the_scope_erase(guarded: Guarded) -> None:
    service, keys = guarded
    with client_for(service, keys["capture"]) as client:
        refused = client.delete("/v1/captures/" + "0" * 28, params={"erase": "true"})
        assert (refused.status_code, refused.json()["type"].rpartition(":")[2]) == (403, "scope-missing")
        assert client.delete("/v1/captures/" + "0" * 28).status_code == 404
        bulk = {"action": "erase", "ids": ["0" * 28]}
        assert client.post("/v1/captures/bulk", json=bulk).status_code == 403


def test_the_first_key_is_not_made_over_http(service: RunningService) -> None:
    with client_for(service, None) as client:
        refused = client.post("/v1/keys", json={"name": "mine", "scopes": ["admin"]})
        assert (refused.status_code, refused.json()["type"].rpartition(":")[2]) == (403, "first-key")
        assert client.get("/v1/jobs").status_code == 200  # it is as open as before


def test_every_answer_has_the_headers_that_browsers_heed(service: RunningService) -> None:
    with client_for(service, None) as client:
        for answer in (client.get("/healthz"), client.get("/v1/nowhere"), client.get("/docs")):
            assert "frame-ancestors 'none'" in answer.headers["content-security-policy"]
            assert answer.headers["x-content-type-options"] == "nosniff"


def test_a_json_body_is_not_awaited_from_nobody(guarded: Guarded) -> None:
    service, _ = guarded
    head = f"POST /v1/sessions HTTP/1.1\r\nHost: 127.0.0.1:{service.port}\r\nContent-Type: application/json\r\n"
    with socket.create_connection(("127.0.0.1", service.port), timeout=10) as client:
        client.sendall(head.encode() + b"Content-Length: 200000000\r\n\r\n")
        assert client.recv(1 << 16).split()[1] == b"401"


def test_a_key_cannot_remove_itself_and_a_removed_one_is_refused(guarded: Guarded) -> None:
    service, keys = guarded
    with client_for(service, keys["admin"]) as admin:
        made = admin.post("/v1/keys", json={"name": "short", "scopes": ["read"]}).json()
        with client_for(service, made["key"]) as client:
            foreign = {"host": "heads.example", "origin": "http://evil.example"}  # no cookie to steal
            assert client.get("/v1/jobs", headers=foreign).status_code == 200
            assert admin.delete(f"/v1/keys/{made['id']}").status_code == 204
            assert client.get("/v1/jobs").status_code == 401
        assert admin.delete(f"/v1/keys/{keys['admin'].split('_')[1]}").status_code == 409


@pytest.mark.parametrize("url", ["http://[", "http://", "https://a..b/"])
def test_a_webhook_at_no_address_is_refused(guarded: Guarded, url: str) -> None:
    service, keys = guarded
    with client_for(service, keys["admin"]) as admin:
        refused = admin.post("/v1/webhooks", json={"url": url})
        assert (refused.status_code, refused.json()["type"]) == (422, "urn:eigenhead:problem:url-refused")
        assert admin.get("/v1/webhooks").json() == {"webhooks": []}


def test_a_key_has_a_limit_of_jobs(guarded: Guarded, tmp_path: Path) -> None:
    service, keys = guarded
    with client_for(service, keys["admin"]) as client:
        capture = upload(client, packed(small_capture(tmp_path / "capture"))).json()
        job = {"capture_id": capture["id"], "settings": {"front": "long"}}
        jobs = [client.post("/v1/jobs", json=job) for _ in range(4)]
        assert [response.status_code for response in jobs] == [202, 202, 202, 429]
        assert "retry-after" in jobs[3].headers
        for response in jobs[:3]:
            client.post(f"/v1/jobs/{response.json()['id']}/cancel")


@pytest.mark.slow
def test_webhooks_are_signed_and_tried_again(tmp_path: Path) -> None:
    with hooked(fails_first=True) as receiver, served_client(tmp_path / "data") as (_, client):
        hook = client.post("/v1/webhooks", json={"url": receiver.url + "/hook"}).json()
        assert "secret" not in client.get("/v1/webhooks").json()["webhooks"][0]
        capture = upload(client, packed(small_capture(tmp_path / "capture"))).json()
        job = client.post("/v1/jobs", json={"capture_id": capture["id"]}).json()
        await_state(client, job["id"], ("succeeded",))
        await_true(lambda: len(receiver.received) == 2)
    (first, body), (second, again) = receiver.received
    assert first["webhook-id"] == second["webhook-id"]
    assert body == again
    assert json.loads(body) == {"type": "job.succeeded", "data": {"job_id": job["id"]}}
    key = base64.b64decode(hook["secret"].removeprefix("whsec_"))
    signed = f"{second['webhook-id']}.{second['webhook-timestamp']}.".encode() + again
    expected = base64.b64encode(hmac.new(key, signed, hashlib.sha256).digest()).decode()
    assert second["webhook-signature"] == f"v1,{expected}"
