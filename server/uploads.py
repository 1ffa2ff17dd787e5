"""Receiving files: multipart bodies and resumable tus uploads, straight to the data folder.

The body is parsed here, not by the framework, so that a key and free space are looked at before the first byte, no
file is held in memory or in a temporary folder elsewhere, and every write happens in a thread.
"""

import base64
import fcntl
import hashlib
import json
import os
import time
from collections.abc import AsyncIterator, Callable, Iterable, Iterator
from contextlib import contextmanager, suppress
from pathlib import Path
from typing import Any, TypeVar

import anyio
import anyio.to_thread
from fastapi import Request
from python_multipart.exceptions import FormParserError
from python_multipart.multipart import MultipartParser, parse_options_header

from rig.files import write_atomically
from server.problems import Problem, not_found
from server.settings import ServiceSettings
from server.store import Store, is_id, new_id

T = TypeVar("T")
BLOCK_BYTES = 1 << 20
FIELD_BYTES = 1 << 16  # of a form field that is no file
UPLOAD_FORMAT = "eigenhead-upload/1"


class Threads:
    """Thread pools of bounded size, apart from the one that the framework's handlers use, so that fifty uploads that
    wait for their turn do not keep a status request waiting."""

    def __init__(self, disk: int = 8, checks: int = 2) -> None:
        self._disk, self._checks = anyio.CapacityLimiter(disk), anyio.CapacityLimiter(checks)

    async def disk(self, function: Callable[..., T], *arguments: Any) -> T:
        return await anyio.to_thread.run_sync(function, *arguments, limiter=self._disk)

    async def check(self, function: Callable[..., T], *arguments: Any) -> T:
        return await anyio.to_thread.run_sync(function, *arguments, limiter=self._checks)


def described_form(file: str, fields: Iterable[str], **described: str) -> dict[str, Any]:
    """OpenAPI's word for a multipart body of one file, text ``fields``, and further ones with a description."""
    texts: dict[str, dict[str, str]] = {name: {"type": "string"} for name in fields}
    texts |= {name: {"type": "string", "description": text} for name, text in described.items()}
    properties = {"file": {"type": "string", "format": "binary", "description": file}} | texts
    schema = {"type": "object", "required": ["file"], "properties": properties}
    return {"requestBody": {"required": True, "content": {"multipart/form-data": {"schema": schema}}}}


def check_length(request: Request, store: Store, settings: ServiceSettings) -> None:
    """Judges the announced length: 413 if it is too much, 507 if the disk has no room for it twice (packed,
    unpacked)."""
    text = request.headers.get("content-length")
    length = int(text) if text and text.isascii() and text.isdigit() else 0
    if length > settings.body_bytes:
        raise too_large(settings)
    store.reserve(2 * length, settings.free_bytes)


def too_large(settings: ServiceSettings) -> Problem:
    return Problem(413, "upload-too-large", f"An upload may have {settings.body_bytes:,} bytes.")


async def receive_multipart(
    request: Request, folder: Path, settings: ServiceSettings, threads: Threads
) -> tuple[Path, dict[str, str]]:
    """Writes the part ``file`` into ``folder``; returns its path and the other fields.

    Raises problems: 415 for another content type, 400 for a body that breaks off, 422 without a ``file``, 413.
    """
    kind, options = parse_options_header(request.headers.get("content-type"))
    boundary = options.get(b"boundary")
    if kind != b"multipart/form-data" or not boundary:
        raise Problem(415, "unsupported-media-type", "Send multipart/form-data with the archive as the part 'file'.")
    form = _Form()
    try:
        parser = MultipartParser(boundary, form.callbacks())
    except FormParserError as error:
        raise Problem(400, "malformed-body", f"The multipart boundary is no good ({error}).") from error
    path = folder / "upload"
    received = 0
    target = await threads.disk(path.open, "xb")
    try:
        async for chunk in request.stream():
            received += len(chunk)
            if received > settings.body_bytes:
                raise too_large(settings)
            try:
                parser.write(chunk)
            except FormParserError as error:
                raise Problem(400, "malformed-body", f"The body is no multipart/form-data ({error}).") from error
            if len(form.pending) >= BLOCK_BYTES:
                await threads.disk(target.write, form.take())
        await threads.disk(target.write, form.take())
    finally:
        await threads.disk(target.close)
    if not form.ended:
        raise Problem(400, "malformed-body", "The multipart body breaks off before its end; send it again.")
    if not form.files:
        raise Problem(422, "file-missing", "The form has no part 'file' that holds the archive.", ["file: missing"])
    return path, form.fields


class _Form:
    """What the parser's callbacks collect: the bytes of ``file`` that are not on the disk yet, and the fields."""

    def __init__(self) -> None:
        self.pending = bytearray()
        self.fields: dict[str, str] = {}
        self.files = 0
        self.ended = False
        self._header, self._value = b"", b""
        self._name, self._data = "", bytearray()

    def callbacks(self) -> Any:
        return {
            "on_part_begin": self._part_begin,
            "on_header_field": lambda data, start, end: self._add_header(data[start:end]),
            "on_header_value": lambda data, start, end: self._add_value(data[start:end]),
            "on_header_end": self._header_end,
            "on_part_data": self._part_data,
            "on_part_end": self._part_end,
            "on_end": self._end,
        }

    def take(self) -> bytes:
        data, self.pending = bytes(self.pending), bytearray()
        return data

    def _part_begin(self) -> None:
        self._name, self._data = "", bytearray()

    def _add_header(self, data: bytes) -> None:
        self._header += data

    def _add_value(self, data: bytes) -> None:
        self._value += data

    def _header_end(self) -> None:
        if self._header.lower() == b"content-disposition":
            self._name = parse_options_header(self._value)[1].get(b"name", b"").decode("utf-8", "replace")
            self.files += self._name == "file"
        self._header, self._value = b"", b""

    def _part_data(self, data: bytes, start: int, end: int) -> None:
        if self._name == "file" and self.files == 1:
            self.pending += data[start:end]
        elif self._name == "file":
            raise Problem(
                422, "file-repeated", "The form has several parts 'file'; send one archive.", ["file: repeated"]
            )
        elif len(self._data) + end - start > FIELD_BYTES:
            raise Problem(
                413, "field-too-large", f"The form field {self._name!r:.80} is longer than {FIELD_BYTES:,} bytes."
            )
        else:
            self._data += data[start:end]

    def _part_end(self) -> None:
        if self._name != "file":
            self.fields[self._name] = self._data.decode("utf-8", "replace")

    def _end(self) -> None:
        self.ended = True


class ResumableUploads:
    """tus 1.0 uploads on disk: ``uploads/<id>/upload.json`` and ``uploads/<id>/data``.

    The length of ``data`` is the offset: what a killed service had written is what the client continues from.
    https://tus.io/protocols/resumable-upload
    """

    def __init__(self, store: Store, settings: ServiceSettings) -> None:
        self._store, self._settings = store, settings

    def create(self, length: int, fields: dict[str, str], key: str) -> dict[str, Any]:
        if length > self._settings.body_bytes:
            raise too_large(self._settings)
        self._store.reserve(2 * length + self._promised(), self._settings.free_bytes)
        identity = new_id()
        folder = self._store.folder("uploads", identity)
        folder.mkdir(parents=True)
        (folder / "data").touch()
        expires = time.time() + self._settings.upload_hours * 3600
        record = {"format": UPLOAD_FORMAT, "id": identity, "length": length, "fields": fields, "key": key}
        record |= {"expires": expires, "capture": None}
        self.save(record)
        return record

    def get(self, identity: str) -> dict[str, Any]:
        """Raises a 404 problem, also for what expired."""
        if not is_id(identity):
            raise not_found("upload", identity)
        with suppress(OSError, ValueError):
            record = json.loads((self._store.folder("uploads", identity) / "upload.json").read_bytes())
            if record["expires"] > time.time():
                return record
        raise not_found("upload", identity)

    def offset(self, record: dict[str, Any]) -> int:
        """Bytes that are here; all of them once the capture was made and the data let go."""
        if record["capture"] is not None:
            return record["length"]
        return self.data(record).stat().st_size

    def data(self, record: dict[str, Any]) -> Path:
        return self._store.folder("uploads", record["id"]) / "data"

    def save(self, record: dict[str, Any]) -> None:
        path = self._store.folder("uploads", record["id"]) / "upload.json"
        write_atomically(path, json.dumps(record).encode())

    @contextmanager
    def lock(self, record: dict[str, Any]) -> Iterator[None]:
        """One writer at a time, in this process or another. Raises a 409 problem."""
        with (self.data(record).parent / "upload.json").open("rb") as stream:
            try:
                fcntl.flock(stream, fcntl.LOCK_EX | fcntl.LOCK_NB)
            except BlockingIOError as error:
                detail = "Another request is writing to this upload; ask with HEAD and go on from there."
                raise Problem(409, "upload-busy", detail) from error
            yield

    def remove(self, identity: str) -> None:
        self._store.remove(self._store.folder("uploads", identity))

    def sweep(self) -> int:
        """Removes what expired."""
        removed = 0
        for identity in self._store.ids("uploads"):
            try:
                self.get(identity)
            except Problem:
                if (self._store.folder("uploads", identity) / "upload.json").is_file():
                    self.remove(identity)
                    removed += 1
        return removed

    async def append(
        self, record: dict[str, Any], stream: AsyncIterator[bytes], checksum: str | None, threads: Threads
    ) -> int:
        """Appends a PATCH's body and returns the new offset. A wrong checksum takes the bytes back (460)."""
        path, before = self.data(record), self.offset(record)
        digest = _digest(checksum)
        target = await threads.disk(path.open, "ab")
        size, pending, complete = before, bytearray(), False
        try:
            async for chunk in stream:
                size += len(chunk)
                if size > record["length"]:
                    raise Problem(413, "upload-too-large", f"More bytes than the announced {record['length']:,}.")
                pending += chunk
                if len(pending) >= BLOCK_BYTES:
                    await threads.disk(_write, target, bytes(pending), digest)
                    pending = bytearray()
            complete = True
        finally:  # a connection that breaks leaves what arrived, so that the client may go on from there
            with anyio.CancelScope(shield=True):
                await threads.disk(_finish, target, bytes(pending), digest)
                if checksum is not None and not (complete and _matches(digest, checksum)):
                    await threads.disk(os.truncate, path, before)
        if checksum is not None and not _matches(digest, checksum):
            raise Problem(460, "checksum-mismatch", "The bytes do not have the announced checksum; send them again.")
        return size

    def _promised(self) -> int:
        """Bytes that unfinished uploads may still bring."""
        total = 0
        for identity in self._store.ids("uploads"):
            with suppress(Problem, OSError):
                record = self.get(identity)
                total += 0 if record["capture"] else record["length"] - self.offset(record)
        return total


def _digest(checksum: str | None) -> Any:
    algorithm = "sha256" if checksum is None else checksum.partition(" ")[0]
    if algorithm not in ("sha1", "sha256", "md5"):
        raise Problem(400, "unknown-checksum", f"Checksum algorithm {algorithm!r:.40}; sha1, sha256 and md5 are known.")
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
