"""The bytes of a resumable upload: what is kept of those that came, whatever becomes of the rest."""

import asyncio
import base64
import hashlib
import socket
from collections.abc import AsyncIterator
from pathlib import Path

import httpx
import pytest

from server.http.routes.uploads import append
from server.services.threads import Threads
from server.services.uploads import ResumableUploads
from server.settings import ServiceSettings
from server.storage.store import Store
from server.wire.problems import Problem
from tests.support.services import RunningService

TUS = {"Tus-Resumable": "1.0.0"}


@pytest.fixture
def uploads(tmp_path: Path) -> ResumableUploads:
    return ResumableUploads(Store(tmp_path), ServiceSettings(data=tmp_path, free_bytes=0))


@pytest.mark.parametrize(("checksum", "kept"), [(None, 30), ("sha256 AAAA", 0)])
def test_a_vanished_client_is_given_up_and_its_bytes_stay(
    uploads: ResumableUploads, checksum: str | None, kept: int
) -> None:
    """Bytes under a checksum count only all together."""
    record = uploads.create(100, {}, "key")

    async def stream() -> AsyncIterator[bytes]:
        yield bytes(10)
        yield bytes(20)
        await asyncio.sleep(60)

    with pytest.raises(Problem, match=r"Nothing more came for 0\.05 s") as refused:
        asyncio.run(append(uploads, record, stream(), checksum, Threads(), silent_s=0.05))
    assert (refused.value.status, refused.value.kind) == (408, "body-silent")
    assert uploads.offset(record) == kept


def test_only_the_pause_counts_and_not_the_whole(uploads: ResumableUploads) -> None:
    record = uploads.create(100, {}, "key")

    async def stream() -> AsyncIterator[bytes]:
        for _ in range(10):
            await asyncio.sleep(0.03)
            yield bytes(10)

    checksum = "sha256 " + base64.b64encode(hashlib.sha256(bytes(100)).digest()).decode()
    assert asyncio.run(append(uploads, record, stream(), checksum, Threads(), silent_s=0.2)) == 100


def test_an_upload_is_not_removed_under_its_writer(service: RunningService, http: httpx.Client, archive: bytes) -> None:
    where = http.post("/v1/uploads", headers=TUS | {"Upload-Length": str(len(archive))}).headers["location"]
    head = f"PATCH {where} HTTP/1.1\r\nHost: 127.0.0.1:{service.port}\r\nTus-Resumable: 1.0.0\r\nUpload-Offset: 0\r\n"
    head += (
        f"Content-Type: application/offset+octet-stream\r\nContent-Length: {len(archive)}\r\nExpect: 100-continue\r\n"
    )
    with socket.create_connection(("127.0.0.1", service.port), timeout=30) as writer:
        writer.sendall(head.encode() + b"\r\n")
        assert b"100 Continue" in writer.recv(1 << 16), "the body is being read: the lock is held"
        busy = http.delete(where, headers=TUS)
        assert (busy.status_code, busy.json()["type"]) == (409, "urn:eigenhead:problem:upload-busy")
        writer.sendall(archive)
        assert b" 204 " in writer.recv(1 << 16)
    assert http.delete(where, headers=TUS).status_code == 204
    assert http.delete(where, headers=TUS).status_code == 404
