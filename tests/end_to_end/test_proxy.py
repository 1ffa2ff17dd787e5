"""The service behind nginx as deploy/nginx.conf sets it up: TLS, pages with their socket, uploads, events, keys."""

import re
import shutil
import socket
import ssl
import subprocess
import sys
import time
from collections.abc import Iterator
from contextlib import contextmanager
from dataclasses import dataclass
from pathlib import Path

import httpx
import pytest
from playwright.sync_api import Browser, expect

from rig.formats.captures.archive import pack_folder
from server.cli.client import Client
from tests.support.services import ROOT, RunningService, await_true, free_port, running_service, small_capture

pytestmark = pytest.mark.slow

HOST = "localhost"
MAIN = """
daemon off; pid {folder}/nginx.pid; error_log stderr; worker_processes 1;
events {{ }}
http {{
    access_log off;
    client_body_temp_path {folder}/body; proxy_temp_path {folder}/proxy; fastcgi_temp_path {folder}/fastcgi;
    uwsgi_temp_path {folder}/uwsgi; scgi_temp_path {folder}/scgi;
    include {folder}/site.conf;
}}
"""


@dataclass(frozen=True)
class Proxied:
    """A service with a key, and the address of the proxy in front of it."""

    service: RunningService
    url: str
    key: str
    certificate: Path

    def client(self, **headers: str) -> httpx.Client:
        all_headers = {"Authorization": f"Bearer {self.key}"} | headers
        context = ssl.create_default_context(cafile=str(self.certificate))
        return httpx.Client(base_url=self.url, headers=all_headers, verify=context, timeout=30, trust_env=False)


@pytest.fixture(scope="module")
def proxied(tmp_path_factory: pytest.TempPathFactory) -> Iterator[Proxied]:
    program = shutil.which("nginx") or shutil.which("nginx", path="/usr/sbin")
    if program is None:
        pytest.skip("nginx is not installed (apt-get install nginx-light)")
    folder = tmp_path_factory.mktemp("proxy")
    port = free_port()
    url = f"https://{HOST}:{port}"
    command = [sys.executable, "-m", "server.cli", "keys", "add", "proxy", "--data", str(folder / "data")]
    key = subprocess.run(command, cwd=ROOT, capture_output=True, text=True, check=True, timeout=120).stdout.strip()
    with running_service(folder / "data", console="true", public_url=url) as service:
        write_site(folder, port, service.port)
        with nginx(program, folder, port):
            yield Proxied(service, url, key, folder / "certificate.pem")


def write_site(folder: Path, port: int, upstream: int) -> None:
    """deploy/nginx.conf with another name, ports and certificate, and nothing else."""
    certificate = [folder / "certificate.pem", folder / "key.pem"]
    command = ["openssl", "req", "-x509", "-newkey", "rsa:2048", "-nodes", "-days", "1", "-subj", f"/CN={HOST}"]
    command += ["-addext", f"subjectAltName=DNS:{HOST}", "-out", str(certificate[0]), "-keyout", str(certificate[1])]
    subprocess.run(command, capture_output=True, check=True, timeout=60)
    site = (ROOT / "deploy" / "nginx.conf").read_text()
    for pattern, value in (
        (r"listen 443 ssl", f"listen 127.0.0.1:{port} ssl"),
        (r"heads\.example;", f"{HOST};"),
        (r"ssl_certificate \S+;", f"ssl_certificate {certificate[0]};"),
        (r"ssl_certificate_key \S+;", f"ssl_certificate_key {certificate[1]};"),
        (r"127\.0\.0\.1:8600", f"127.0.0.1:{upstream}"),
    ):
        site, count = re.subn(pattern, value, site)
        assert count == 1, pattern
    (folder / "site.conf").write_text(site)
    (folder / "nginx.conf").write_text(MAIN.format(folder=folder))


@contextmanager
def nginx(program: str, folder: Path, port: int) -> Iterator[None]:
    with (folder / "nginx.log").open("wb") as log:
        process = subprocess.Popen([program, "-p", str(folder), "-c", str(folder / "nginx.conf")], stderr=log)
    try:
        await_true(lambda: process.poll() is not None or socket.socket().connect_ex(("127.0.0.1", port)) == 0)
        assert process.poll() is None, (folder / "nginx.log").read_text()
        yield
    finally:
        process.terminate()
        process.wait(120)


def test_the_api_answers_with_a_key_alone(proxied: Proxied) -> None:
    with proxied.client() as client:
        assert client.get("/v1/jobs").status_code == 200
        assert client.get("/v1/jobs", headers={"Authorization": ""}).status_code == 401


def test_pages_are_the_proxys_and_no_others(proxied: Proxied) -> None:
    socket_path = "/_nicegui_ws/socket.io/?EIO=4&transport=polling"
    with proxied.client() as client:
        for path in ("/sign-in", socket_path):
            assert client.get(path, headers={"Origin": proxied.url}).status_code == 200
            assert client.get(path, headers={"Origin": "https://evil.example"}).status_code == 403
        assert client.get("/sign-in", headers={"Host": "evil.example"}).status_code == 403


def test_a_refused_upload_is_told_why(proxied: Proxied) -> None:
    with proxied.client() as client:
        for _ in range(40):  # races: a reset overtook the answer; nginx ended a connection that it had promised to keep
            answer = client.post("/v1/reconstructions", files={"file": bytes(4 << 20)}, headers={"Authorization": "x"})
            assert answer.status_code == 401, answer.text
            assert answer.json()["type"].endswith("key-missing")


def test_upload_events_and_result_pass(proxied: Proxied, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setenv("SSL_CERT_FILE", str(proxied.certificate))
    pack_folder(small_capture(tmp_path / "capture", size=400), tmp_path / "capture.tar")
    assert (tmp_path / "capture.tar").stat().st_size > 1 << 20  # nginx's own limit of a body
    with Client(proxied.url, proxied.key) as client:
        capture = client.upload(tmp_path / "capture.tar")
        job = client.submit(capture["id"], settings={"front": "quiet"})
        arrived = [(time.monotonic(), kind) for kind, _ in client.events(job["id"])]
        assert arrived[-1][1] == "end"
        assert arrived[-1][0] - arrived[0][0] > 0.9  # as they happened, and not together at the end
        client.download(job["id"], tmp_path / "out")
    assert (tmp_path / "out" / "head.ply").is_file()


def test_a_browser_signs_in_and_sees_the_rig(proxied: Proxied, browser: Browser) -> None:
    context = browser.new_context(ignore_https_errors=True)
    page = context.new_page()
    page.goto(proxied.url + "/")
    page.get_by_label("API key").fill(proxied.key)
    page.keyboard.press("Enter")
    expect(page.locator("article.tile").first).to_be_visible()  # its state came over the socket
    page.goto(proxied.url + "/docs")
    expect(page.get_by_text("submit_job")).to_be_visible()
    context.close()
