"""What a stranger without a key may cost: one real service with few open files."""

import json
import socket
import threading
import time
from collections.abc import Iterator
from concurrent.futures import ThreadPoolExecutor

import httpx
import pytest
import uvicorn
from starlette.types import Receive, Scope, Send

from server.http import connections
from tests.support.attacks import (
    CHUNKED,
    REQUEST,
    Witness,
    flood_header,
    half_body,
    limit_files,
    seconds_to_end,
    silent_connections,
)
from tests.support.services import RunningService, running_service

FILES = 512  # the service then takes 128 connections, 64 of one address; `attacks` has 1,024 and 1,100


@pytest.fixture(scope="module")
def service(tmp_path_factory: pytest.TempPathFactory) -> Iterator[RunningService]:
    with running_service(tmp_path_factory.mktemp("strangers") / "data", worker=False) as running:
        limit_files(running, FILES)
        yield running


@pytest.fixture(scope="module")
def calm(service: RunningService) -> Witness:
    with Witness(service).watching() as witness:
        time.sleep(1.5)
    return witness


@pytest.mark.parametrize("begin", [REQUEST, CHUNKED], ids=["header", "trailer"])
def test_a_header_without_end_is_refused_at_its_bound(service: RunningService, calm: Witness, begin: bytes) -> None:
    with Witness(service).watching() as witness:
        ends = [flood_header(service, 98, begin) for _ in range(5)]
        time.sleep(0.3)
    witness.check(calm)
    for sent, answer in ends:
        assert sent < 20_000_000  # what both sockets hold
        assert not answer or answer.startswith((b"HTTP/1.1 431 ", b"HTTP/1.1 404 "))  # a reset may take it away


def test_a_header_of_the_permitted_length_passes_and_a_longer_one_is_told(service: RunningService) -> None:
    fits = {f"X-{i}": "a" * 1000 for i in range(30)}
    assert httpx.get(service.url + "/healthz", headers=fits).status_code == 200
    with socket.create_connection(("127.0.0.1", service.port), timeout=30) as sock:
        sock.sendall(b"GET /healthz HTTP/1.1\r\nHost: localhost\r\nX-Long: " + b"a" * connections.HEADER_BYTES)
        head, _, body = b"".join(iter(lambda: sock.recv(1 << 16), b"")).partition(b"\r\n\r\n")
    assert head.startswith(b"HTTP/1.1 431 ")
    assert json.loads(body)["detail_message"]["parameters"] == {"bytes": connections.HEADER_BYTES}


@pytest.mark.parametrize("begin", [b"", half_body("/v1/jobs")], ids=["silent", "half"])
def test_connections_that_wait_leave_room_for_others(service: RunningService, calm: Witness, begin: bytes) -> None:
    with Witness(service).watching() as witness, silent_connections(service, 300, begin) as opened:
        time.sleep(1.0)
        assert len(opened) == 300
    witness.check(calm)


@pytest.mark.slow
def test_half_headers_and_half_bodies_end_after_half_a_minute(service: RunningService) -> None:
    header, body = (silent_connections(service, 1, begin) for begin in (b"GET /healthz HT", half_body("/v1/jobs")))
    with header as begun, body as others, ThreadPoolExecutor() as pool:
        assert all(25.0 < seconds < 55.0 for seconds in pool.map(seconds_to_end, begun + others, (90.0, 90.0)))


def test_a_reader_who_takes_nothing_is_dropped(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(connections, "STALL_S", 0.3)
    ended = threading.Event()

    async def answer(scope: Scope, receive: Receive, send: Send) -> None:
        await send({"type": "http.response.start", "status": 200, "headers": []})
        for _ in range(64):
            await send({"type": "http.response.body", "body": bytes(1 << 20), "more_body": True})
        ended.set()

    config = uvicorn.Config(answer, http=connections.BoundedConnection, lifespan="off", log_config=None)
    server = uvicorn.Server(config)
    with socket.create_server(("127.0.0.1", 0)) as listening:
        serving = threading.Thread(target=server.run, args=([listening],))
        serving.start()
        with socket.create_connection(listening.getsockname()[:2]) as sock:
            sock.sendall(REQUEST + b"\r\n")
            assert ended.wait(20.0)
        server.should_exit = True
        serving.join()
