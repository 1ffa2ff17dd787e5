"""Declares the routes of resumable uploads, tus 1.0 (https://tus.io/protocols/resumable-upload), with its extensions
creation, termination, checksum and expiration.

The PATCH with the last byte is answered with the capture's ``Location``, or with a 422 that names every fault.
"""

import base64
import binascii
import hashlib
import os
from collections.abc import AsyncIterator
from dataclasses import replace
from email.utils import formatdate
from typing import Annotated, Any

import anyio
from fastapi import APIRouter, Header, Request, Response

from rig.errors import InputError
from rig.messages.message import compose
from server.errors import DiskFull, NotFound, Refused, Unavailable
from server.http.auth import ServiceOf, Taker
from server.services.captures import CaptureMetadata
from server.services.keys import Caller
from server.services.service import Service
from server.services.threads import Threads
from server.services.uploads import ResumableUploads
from server.storage.records import UploadRecord
from server.wire.multipart import ABOUT, BLOCK_BYTES
from server.wire.patience import IDLE_TIMEOUT_S, with_idle_timeout
from server.wire.problems import Problem, documented

router = APIRouter(prefix="/v1/uploads", tags=["uploads"])
VERSION = "1.0.0"
Resumable = Annotated[str | None, Header(alias="Tus-Resumable", description=VERSION)]
COMMON = {"Tus-Resumable": VERSION, "Cache-Control": "no-store"}


@router.options("", status_code=204, responses=documented())
def tus_options(service: ServiceOf) -> Response:
    """Returns which parts of the tus protocol this server supports, and the largest upload."""
    headers = {
        "Tus-Version": VERSION,
        "Tus-Extension": "creation,termination,checksum,expiration",
        "Tus-Max-Size": str(service.settings.body_bytes),
        "Tus-Checksum-Algorithm": "sha256,sha1,md5",
    }
    return Response(status_code=204, headers=COMMON | headers)


@router.post("", status_code=201, responses=documented(400, 404, 412, 413, 507))
def tus_create(
    service: ServiceOf,
    caller: Taker,
    tus_resumable: Resumable = None,
    upload_length: Annotated[str | None, Header(alias="Upload-Length", description="bytes of the archive")] = None,
    upload_metadata: Annotated[str | None, Header(alias="Upload-Metadata", max_length=8000)] = None,
) -> Response:
    """Announces an archive of ``Upload-Length`` bytes. ``Upload-Metadata`` may hold session, label, expression and
    tags, separated by commas."""
    _check_version(tus_resumable)
    if not upload_length or not (upload_length.isascii() and upload_length.isdigit()) or len(upload_length) > 18:
        raise Problem(400, "upload-length", compose("upload-length-missing"))
    fields = _metadata(upload_metadata)
    about = CaptureMetadata.of(fields)
    if about.session is not None:
        service.store.session(about.session)
    record = service.uploads.create(int(upload_length), fields, caller.key)
    return Response(status_code=201, headers=COMMON | {"Location": f"/v1/uploads/{record.id}"} | _expires(record))


@router.head("/{upload_id}", responses=documented(404, 412))
def tus_head(service: ServiceOf, caller: Taker, upload_id: str, tus_resumable: Resumable = None) -> Response:
    """Returns how many bytes of an upload have arrived and, once the capture has been made, its ``Location``."""
    _check_version(tus_resumable)
    record = _owned_upload(service, caller, upload_id)
    headers = {"Upload-Offset": str(service.uploads.offset(record)), "Upload-Length": str(record.length)}
    return Response(status_code=200, headers=COMMON | headers | _expires(record) | _location(record))


@router.patch(
    "/{upload_id}",
    status_code=204,
    responses=documented(400, 404, 408, 409, 412, 413, 415, 507) | {460: {"description": "Checksum Mismatch"}},
    openapi_extra={
        "requestBody": {
            "content": {"application/offset+octet-stream": {"schema": {"type": "string", "format": "binary"}}}
        }
    },
)
async def tus_patch(
    service: ServiceOf,
    caller: Taker,
    request: Request,
    upload_id: str,
    *,
    tus_resumable: Resumable = None,
    upload_offset: Annotated[str | None, Header(alias="Upload-Offset")] = None,
    upload_checksum: Annotated[str | None, Header(alias="Upload-Checksum", max_length=200)] = None,
) -> Response:
    """Appends bytes at ``Upload-Offset``. After the last byte the service makes the capture: the answer has the
    capture's ``Location``, or 422 names every fault."""
    _check_version(tus_resumable)
    if request.headers.get("content-type") != "application/offset+octet-stream":
        raise Problem(415, "unsupported-media-type", compose("offset-stream-wanted"))
    record = await service.threads.disk(_owned_upload, service, caller, upload_id)
    with service.uploads.lock(record.id):
        # read again under the lock: another request may have made the capture meanwhile
        record = await service.threads.disk(_owned_upload, service, caller, upload_id)
        here = await service.threads.disk(service.uploads.offset, record)
        if upload_offset != str(here):
            raise Problem(409, "wrong-offset", compose("upload-offset-wrong", offset=here))
        if record.capture is None:
            here = await append(service.uploads, record, request.stream(), upload_checksum, service.threads)
        if here == record.length and record.capture is None:
            record = await service.threads.check(_finish, service, record, key=record.key)
    headers = {"Upload-Offset": str(here)}
    return Response(status_code=204, headers=COMMON | headers | _expires(record) | _location(record))


@router.delete("/{upload_id}", status_code=204, responses=documented(404, 409, 412))
def tus_delete(service: ServiceOf, caller: Taker, upload_id: str, tus_resumable: Resumable = None) -> Response:
    """Discards an upload; a capture that was made from it stays. Answers 409 while bytes of the upload are arriving."""
    _check_version(tus_resumable)
    record = _owned_upload(service, caller, upload_id)
    with service.uploads.lock(record.id):
        service.uploads.remove(record.id)
    return Response(status_code=204, headers=COMMON)


def _finish(service: Service, record: UploadRecord) -> UploadRecord:
    """Makes the capture. If the archive cannot be used, it is removed with its upload."""
    try:
        with service.store.incoming() as folder:
            data = service.uploads.data(record)
            capture = service.captures.accept(data, folder, CaptureMetadata.of(record.fields))
    except (Unavailable, DiskFull):  # the client may try again: keep the upload
        raise
    except (InputError, Refused):
        service.uploads.remove(record.id)
        raise
    record = replace(record, capture=capture.id)
    service.uploads.save(record)
    service.uploads.data(record).unlink(missing_ok=True)
    return record


def _owned_upload(service: Service, caller: Caller, upload_id: str) -> UploadRecord:
    record = service.uploads.get(upload_id)
    if record.key != caller.key and not caller.may("admin"):
        raise NotFound(compose("thing-upload"), upload_id)
    return record


def _check_version(version: str | None) -> None:
    if version != VERSION:
        raise Problem(
            412, "tus-version", compose("tus-version-wanted", version=VERSION), headers={"Tus-Version": VERSION}
        )


def _metadata(text: str | None) -> dict[str, str]:
    """Decodes tus metadata, ``key base64, key base64``. Raises a 400 problem for a text of another form."""
    fields: dict[str, str] = {}
    for part in (text or "").split(","):
        key, _, value = part.strip().partition(" ")
        if not key:
            continue
        try:
            decoded = base64.b64decode(value, validate=True).decode()
        except (binascii.Error, ValueError) as error:
            raise Problem(400, "upload-metadata", compose("upload-metadata-unreadable", key=f"{key!r:.80}")) from error
        if key in ABOUT:
            fields[key] = decoded
    return fields


def _expires(record: UploadRecord) -> dict[str, str]:
    return {"Upload-Expires": formatdate(record.expires, usegmt=True)}


def _location(record: UploadRecord) -> dict[str, str]:
    return {} if record.capture is None else {"Location": f"/v1/captures/{record.capture}"}


async def append(
    uploads: ResumableUploads,
    record: UploadRecord,
    stream: AsyncIterator[bytes],
    checksum: str | None,
    threads: Threads,
    silent_s: float = IDLE_TIMEOUT_S,
) -> int:
    """Appends the body of a PATCH to an upload and returns the new offset (bytes). The bytes that have arrived stay if
    the connection breaks or the process is killed.

    Raises problems: 460 for a wrong checksum, after removing the bytes of the body again; 408 for a client that is
    silent for ``silent_s`` seconds; 413 for more bytes than were announced; 400 for an unknown kind of checksum.
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
            await threads.disk(_close, target, bytes(pending), digest)
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


def _close(target: Any, data: bytes, digest: Any) -> None:
    try:
        _write(target, data, digest)
        target.flush()
        os.fsync(target.fileno())
    finally:
        target.close()
