"""Captures that come from a server elsewhere: off by default, judged at each redirection, bounded in bytes and time;
and a job's own webhook, name and log."""

import time
from collections.abc import Iterator
from http.server import BaseHTTPRequestHandler
from pathlib import Path

import httpx
import pytest

from tests.support.loopback import Hook, hooked
from tests.support.services import RunningService, await_state, await_true, imported, packed_capture, running_service


class Store(BaseHTTPRequestHandler):
    """A server elsewhere: /a.tar is a capture, other paths misbehave."""

    archive = b""

    def do_GET(self) -> None:
        where = self.path.strip("/")
        if where.startswith("to/"):
            self.send_response(302)
            self.send_header("Location", where.removeprefix("to/"))
            self.end_headers()
        elif where == "a.tar":
            self._give(self.archive)
        elif where == "short":
            self._give(self.archive[:1000], length=len(self.archive))
        elif where == "endless":
            self.send_response(200)
            self.end_headers()
            while not self.wfile.closed:
                self.wfile.write(bytes(1 << 16))
        elif where == "slow":
            self.send_response(200)
            self.end_headers()
            time.sleep(6)
        else:
            self.send_error(404)

    def _give(self, data: bytes, length: int | None = None) -> None:
        self.send_response(200)
        self.send_header("Content-Length", str(length or len(data)))
        self.end_headers()
        self.wfile.write(data)


@pytest.fixture(scope="module")
def store(tmp_path_factory: pytest.TempPathFactory) -> Iterator[Hook]:
    Store.archive = packed_capture(tmp_path_factory.mktemp("archive")).read_bytes()
    with hooked(base=Store) as store:
        yield store


@pytest.fixture(scope="module")
def service(store: Hook, tmp_path_factory: pytest.TempPathFactory) -> Iterator[RunningService]:
    origins = f'["{store.url}"]'
    with running_service(
        tmp_path_factory.mktemp("service") / "data",
        import_origins=origins,
        webhook_origins=origins,
        import_s="3",
        body_bytes=str(4 << 20),
    ) as service:
        yield service


@pytest.mark.parametrize("way", ["{0}/a.tar", "{0}/to//a.tar", "{0}/to/{0}/to/{0}/a.tar"])
def test_an_archive_elsewhere_becomes_a_capture(way: str, service: RunningService, store: Hook) -> None:
    made = imported(service, way.format(store.url))
    assert made.status_code == 201, made.text
    capture = httpx.get(service.url + made.headers["location"]).json()
    assert (capture["label"], capture["source"], len(capture["cameras"])) == ("Anna", "upload", 3)


@pytest.mark.parametrize(
    ("way", "kind", "why"),
    [
        ("http://127.0.0.1:1/a.tar", "url-refused", "did not allow"),
        ("{0}/to/http://127.0.0.1:1/", "url-refused", "did not allow"),
        ("{0}/to/http://169.254.169.254/latest/meta-data", "url-refused", "did not allow"),
        ("{0}/to/file:///etc/passwd", "url-refused", "no https"),
        ("{0}/to/https://a..b/", "url-refused", "not a URL"),
        ("{0}/to/https://xn--/", "import-failed", "IDNA"),
        ("{0}/to/http://a:b/", "import-failed", "Invalid URL"),
        ("{0}/to/" * 7 + "{0}/a.tar", "import-failed", "redirected more than 5 times"),
        ("{0}/none", "import-failed", "answered 404"),
        ("{0}/short", "import-failed", "broke off"),
        ("{0}/slow", "import-failed", "within 3 s"),
        ("{0}/endless", "upload-too-large", "4,194,304"),
    ],
)
def test_what_is_refused_leaves_nothing(way: str, kind: str, why: str, service: RunningService, store: Hook) -> None:
    before = httpx.get(service.url + "/v1/captures").json()
    refused = imported(service, way.format(store.url))
    assert refused.status_code == (413 if kind == "upload-too-large" else 422), refused.text
    assert refused.json()["type"].endswith(kind)
    assert why in refused.json()["detail"]
    assert httpx.get(service.url + "/v1/captures").json() == before
    assert list((service.data / "incoming").iterdir()) == []


def test_a_jobs_own_webhook_name_and_log(service: RunningService, store: Hook) -> None:
    capture = imported(service, store.url + "/a.tar").json()["id"]
    secret = "whsec_" + "A" * 32
    with httpx.Client(base_url=service.url, timeout=30) as client:
        wanted = {"capture_id": capture, "name": "Anna, fine", "settings": {"front": "moved"}}
        elsewhere = client.post("/v1/jobs", json=wanted | {"webhook": {"url": "http://127.0.0.1:1/"}})
        assert (elsewhere.status_code, elsewhere.json()["type"].rpartition(":")[2]) == (422, "url-refused")
        job = client.post("/v1/jobs", json=wanted | {"webhook": {"url": store.url + "/hook", "secret": secret}}).json()
        assert job["name"] == "Anna, fine"
        assert await_state(client, job["id"], ("succeeded",))["name"] == "Anna, fine"
        await_true(lambda: store.received, 30)
        headers, body = store.received[0]
        assert headers["webhook-signature"].startswith("v1,")
        assert job["id"] in body.decode()
        assert "job.succeeded" in body.decode()
        assert client.get("/v1/webhooks").json() == {"webhooks": []}
        log = client.get(f"/v1/jobs/{job['id']}/log")
        assert log.headers["content-type"].startswith("text/plain")
        for words in ("job started", "stage stage=fit", "cam02 has moved by 5.0 px", "job finished"):
            assert words in log.text, log.text
        assert client.get(f"/v1/jobs/{'0' * 28}/log").status_code == 404
        broken = client.post("/v1/jobs", json={"capture_id": capture, "settings": {"front": "bug"}}).json()["id"]
        await_state(client, broken, ("failed",))
        log = client.get(f"/v1/jobs/{broken}/log").text
        assert "job failed" in log
        assert "Traceback" not in log


def test_imports_and_webhooks_of_jobs_are_off_by_default(store: Hook, tmp_path: Path) -> None:
    with running_service(tmp_path / "data", worker=False) as service:
        for url, variable in ((store.url + "/a.tar", "ORIGINS"), ("s3://studio-in/in/anna.tar", "PREFIXES")):
            refused = imported(service, url)
            assert (refused.status_code, refused.json()["type"].rpartition(":")[2]) == (403, "imports-off")
            assert f"EIGENHEAD_IMPORT_{variable}" in refused.json()["detail"]
        wanted = {"capture_id": "0" * 28, "webhook": {"url": store.url}}
        assert httpx.post(service.url + "/v1/jobs", json=wanted).status_code in (404, 422)
