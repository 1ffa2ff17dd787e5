"""Receives the bytes of a resumable upload: https://tus.io/protocols/resumable-upload, with its checksum extension."""

import base64
import hashlib
import os
from collections.abc import AsyncIterator
from typing import Any

import anyio

from rig.messages.message import compose
from server.services.threads import Threads
from server.services.uploads import ResumableUploads
from server.storage.records import UploadRecord
from server.wire.multipart import BLOCK_BYTES
from server.wire.patience import IDLE_TIMEOUT_S, with_idle_timeout
from server.wire.problems import Problem


async def append(
    uploads: ResumableUploads,
    record: UploadRecord,
    stream: AsyncIterator[bytes],
    checksum: str | None,
    threads: Threads,
    silent_s: float = IDLE_TIMEOUT_S,
) -> int:
    """Appends the body of a PATCH to an upload and returns the new offset (bytes). Bytes that arrived stay if the
    connection breaks or the process is killed.

    Raises problems: 460 for a wrong checksum, after removing this body's bytes again; 408 for a client that is silent
    for ``silent_s`` seconds; 413 for more bytes than were announced; 400 for an unknown kind of checksum.
    """
    path, before = uploads.data(record), uploads.offset(record)
    digest = _digest(checksum)
    target = await threads.disk(path.open, "ab")
    size, pending, complete = before, bytearray(), False
    try:
        async for chunk in with_idle_timeout(stream, silent_s):
            size += len(chunk)
            if size > record.length:
                raise Problem(413, "upload-too-large", compose("upload-longer-than-announced", bytes=record.length))
            pending += chunk
            if len(pending) >= BLOCK_BYTES:
                await threads.disk(_write, target, bytes(pending), digest)
                pending = bytearray()
        complete = True
    finally:  # also where the connection breaks: the client continues from the bytes that arrived
        with anyio.CancelScope(shield=True):
            await threads.disk(_finish, target, bytes(pending), digest)
            if checksum is not None and not (complete and _matches(digest, checksum)):
                await threads.disk(os.truncate, path, before)
    if checksum is not None and not _matches(digest, checksum):
        raise Problem(460, "checksum-mismatch", compose("upload-checksum-wrong"))
    return size


def _digest(checksum: str | None) -> Any:
    algorithm = "sha256" if checksum is None else checksum.partition(" ")[0]
    if algorithm not in ("sha1", "sha256", "md5"):
        raise Problem(400, "unknown-checksum", compose("checksum-unknown", algorithm=f"{algorithm!r:.40}"))
    return hashlib.new(algorithm, usedforsecurity=False)


def _matches(digest: Any, checksum: str) -> bool:
    return base64.b64encode(digest.digest()).decode() == checksum.partition(" ")[2].strip()


def _write(target: Any, data: bytes, digest: Any) -> None:
    target.write(data)
    digest.update(data)


def _finish(target: Any, data: bytes, digest: Any) -> None:
    try:
        _write(target, data, digest)
        target.flush()
        os.fsync(target.fileno())
    finally:
        target.close()
