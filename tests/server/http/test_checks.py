"""What an upload may cost others: metadata, time, memory and places, at one real service with two keys."""

import socket
import time
from collections.abc import Iterator
from concurrent.futures import ThreadPoolExecutor
from contextlib import suppress
from pathlib import Path

import httpx
import pytest

from tests.support.attacks import (
    Witness,
    add_keys,
    ask_often,
    client,
    get_begun,
    half_body,
    heavy_capture,
    limit_files,
    silent_connections,
    slow_capture,
)
from tests.support.services import RunningService, await_true, packed, running_service, small_capture, upload

CHECK_S = 12.0


@pytest.fixture(scope="module")
def service(tmp_path_factory: pytest.TempPathFactory) -> Iterator[RunningService]:
    with running_service(tmp_path_factory.mktemp("checks") / "data", worker=False, check_s=str(CHECK_S)) as running:
        limit_files(running, 1024)
        yield running


@pytest.fixture(scope="module")
def keys(service: RunningService) -> list[str]:
    return add_keys(service, "read,capture,submit", "read,capture")


@pytest.mark.parametrize("segment", [65_533, 20])
def test_metadata_is_refused_unread(service: RunningService, keys: list[str], tmp_path: Path, segment: int) -> None:
    archive = heavy_capture(tmp_path / "capture", segment)
    with client(service, keys[0]) as http:
        answer = upload(http, archive)
    assert answer.status_code == 422
    assert any("metadata" in error for error in answer.json()["errors"])  # and not that its check took too long


@pytest.mark.slow
def test_a_slow_check_keeps_no_key_waiting_and_ends(service: RunningService, keys: list[str], tmp_path: Path) -> None:
    slow, fine = slow_capture(tmp_path / "slow"), packed(small_capture(tmp_path / "fine"))
    with client(service, keys[1]) as other:
        assert upload(other, fine).status_code == 201
        for _ in range(2):  # given up by their sender
            with client(service, keys[0], timeout_s=1.5) as attacker, suppress(httpx.TimeoutException):
                upload(attacker, slow)
        with client(service, keys[0]) as attacker, ThreadPoolExecutor() as pool:
            slowly = pool.submit(upload, attacker, slow)
            assert upload(other, fine).status_code == 201
            assert not slowly.done()
            answer = slowly.result()
            assert (answer.status_code, answer.json()["detail_message"]["code"]) == (422, "check-too-long")
            assert upload(attacker, fine).status_code == 201  # what was given up has ended


@pytest.fixture(scope="module")
def calm(service: RunningService, keys: list[str]) -> Witness:
    with Witness(service, keys[1]).watching() as witness:
        time.sleep(2.0)
    return witness


def test_thousands_of_small_requests_leave_others_time(service: RunningService, keys: list[str], calm: Witness) -> None:
    with Witness(service, keys[1]).watching() as witness:
        assert ask_often(service, keys[0], "/v1/captures", 1000) == {200}
    witness.check(calm)


def test_streams_of_a_key_are_bounded_and_leave_others_their_time(
    service: RunningService, keys: list[str], calm: Witness, tmp_path: Path
) -> None:
    """384 connections at 1,024 open files: half of an address, a quarter of a key."""
    with client(service, keys[0]) as http:
        capture = upload(http, packed(small_capture(tmp_path / "capture"))).json()["id"]
        events = http.post("/v1/jobs", json={"capture_id": capture}).headers["Location"] + "/events"
    with silent_connections(service, 120, get_begun(events, keys[0])) as opened:
        assert [sock.recv(12)[9:] for sock in opened] == [b"200"] * 96 + [b"429"] * 24
        with Witness(service, keys[1]).watching() as witness:
            time.sleep(2.0)
    witness.check(calm)


def test_requests_that_wait_leave_their_key_its_time(service: RunningService, keys: list[str]) -> None:
    half = half_body("/v1/captures", keys[0])
    with silent_connections(service, 5, half), client(service, keys[0]) as http:
        time.sleep(0.3)
        began = time.monotonic()
        assert [http.get("/v1/captures").status_code for _ in range(5)] == [200] * 5
        assert time.monotonic() - began < 20.0  # one that is not answered ends after 30 s
    assert "unforeseen" not in service.log.read_text()  # of clients who went


def test_a_client_who_goes_amid_a_body_is_no_fault_of_the_service(service: RunningService, keys: list[str]) -> None:
    with client(service, keys[0]) as http:
        made = http.post("/v1/uploads", headers={"Tus-Resumable": "1.0.0", "Upload-Length": "1000"})
    head = (
        f"PATCH {made.headers['Location']} HTTP/1.1\r\nHost: localhost\r\nTus-Resumable: 1.0.0\r\nUpload-Offset: 0\r\n"
    )
    head += f"Authorization: Bearer {keys[0]}\r\nContent-Type: application/offset+octet-stream\r\n"
    with socket.create_connection(("127.0.0.1", service.port)) as sock:
        sock.sendall(head.encode() + b"Content-Length: 1000\r\n\r\n" + bytes(100))
        time.sleep(0.3)
    await_true(lambda: "method=PATCH" in service.log.read_text())
    (line,) = (line for line in service.log.read_text().splitlines() if "method=PATCH" in line)
    assert "status=409" in line
    assert "unforeseen" not in service.log.read_text()
