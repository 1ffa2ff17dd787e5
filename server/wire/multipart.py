"""Receives multipart bodies straight into the data folder.

The library python-multipart parses, and limits the headers of a part. The form parsers of library and framework are not
used for three reasons: API key and free space are checked before the first byte, no file is held in memory or in
another temporary folder, and every write happens in a thread."""

from collections.abc import Collection, Iterable
from functools import partial
from pathlib import Path
from typing import Any

from fastapi import Request
from python_multipart.exceptions import FormParserError
from python_multipart.multipart import MultipartParser, parse_options_header

from rig.errors import InputError
from rig.messages.message import compose
from rig.text import suggest
from server.services.captures import CaptureMetadata
from server.services.records import CalibrationOut
from server.services.service import Service
from server.services.threads import Threads
from server.services.uploads import too_large
from server.settings import ServiceSettings
from server.storage.records import CaptureRecord, JsonObject
from server.storage.store import Store
from server.wire.patience import IDLE_TIMEOUT_S, await_hang_up, with_idle_timeout
from server.wire.problems import Problem

BLOCK_BYTES = 1 << 20
FIELD_BYTES = 1 << 16  # of a form field that is no file
FIELDS_MOST = 100  # parts of a form; times FIELD_BYTES it bounds the memory of one request
ABOUT = ("session", "label", "expression", "tags")  # the fields of a capture's form
ARCHIVE = ".zip, .tar or .tar.gz"


def described_form(file: str, fields: Iterable[str], **described: str) -> JsonObject:
    """Returns the OpenAPI description of a multipart body: one file, the text fields ``fields``, and further text
    fields with their descriptions."""
    texts: dict[str, dict[str, str]] = {name: {"type": "string"} for name in fields}
    texts |= {name: {"type": "string", "description": text} for name, text in described.items()}
    properties = {"file": {"type": "string", "format": "binary", "description": file}} | texts
    schema = {"type": "object", "required": ["file"], "properties": properties}
    return {"requestBody": {"required": True, "content": {"multipart/form-data": {"schema": schema}}}}


def check_length(request: Request, store: Store, settings: ServiceSettings) -> None:
    """Checks the length that a request announces. Raises TooLarge if it is more than the settings allow, and DiskFull
    if the disk has no space for twice as much: the archive and its unpacked files."""
    text = request.headers.get("content-length")
    length = int(text) if text and text.isascii() and text.isdigit() else 0
    if length > settings.body_bytes:
        raise too_large(settings)
    store.reserve(2 * length, settings.free_bytes)


async def receive_multipart(
    request: Request, folder: Path, store: Store, settings: ServiceSettings, threads: Threads
) -> tuple[Path, dict[str, str]]:
    """Writes the part ``file`` of the body into ``folder`` and returns its path and the other fields.

    Raises DiskFull before a block for which the disk has no space; TooLarge; and problems: 415 for another content
    type, 400 for a body that breaks off, 408 for a client that stops sending, 422 without a ``file`` or with two, 413
    for too many or too long fields.
    """
    kind, options = parse_options_header(request.headers.get("content-type"))
    boundary = options.get(b"boundary")
    if kind != b"multipart/form-data" or not boundary:
        raise Problem(415, "unsupported-media-type", compose("multipart-wanted"))
    form = _Form()
    try:
        parser = MultipartParser(boundary, form.callbacks())
    except FormParserError as error:
        raise Problem(400, "malformed-body", compose("multipart-boundary-wrong", reason=str(error))) from error
    path = folder / "upload"
    received = 0
    target: Any = await threads.disk(path.open, "xb")

    def write(block: bytes) -> None:  # checks each block: a chunked body announces no length to check before
        store.reserve(len(block), settings.free_bytes)
        target.write(block)

    try:
        async for chunk in with_idle_timeout(request.stream(), IDLE_TIMEOUT_S):
            received += len(chunk)
            if received > settings.body_bytes:
                raise too_large(settings)
            try:
                parser.write(chunk)
            except FormParserError as error:
                raise Problem(400, "malformed-body", compose("multipart-malformed", reason=str(error))) from error
            if len(form.pending) >= BLOCK_BYTES:
                await threads.disk(write, form.take())
        await threads.disk(write, form.take())
    finally:
        await threads.disk(target.close)
    if not form.ended:
        raise Problem(400, "malformed-body", compose("multipart-cut-off"))
    if not form.files:
        raise Problem(422, "file-missing", compose("file-missing"), [compose("field-file-missing")])
    return path, form.fields


class _Form:
    """Collects what the parser's callbacks deliver: the fields, and those bytes of ``file`` that are not yet on the
    disk."""

    def __init__(self) -> None:
        self.pending = bytearray()
        self.fields: dict[str, str] = {}
        self.files, self._parts = 0, 0
        self.ended = False
        self._header, self._value = bytearray(), bytearray()
        self._name, self._data = "", bytearray()

    def callbacks(self) -> Any:
        return {
            "on_part_begin": self._part_begin,
            "on_header_field": lambda data, start, end: self._header.extend(data[start:end]),
            "on_header_value": lambda data, start, end: self._value.extend(data[start:end]),
            "on_header_end": self._header_end,
            "on_part_data": self._part_data,
            "on_part_end": self._part_end,
            "on_end": self._end,
        }

    def take(self) -> bytes:
        data, self.pending = bytes(self.pending), bytearray()
        return data

    def _part_begin(self) -> None:
        self._parts += 1
        if self._parts > FIELDS_MOST:
            raise Problem(413, "fields-too-many", compose("form-fields-too-many", most=FIELDS_MOST))
        self._name, self._data = "", bytearray()

    def _header_end(self) -> None:
        if self._header.lower() == b"content-disposition":
            self._name = parse_options_header(bytes(self._value))[1].get(b"name", b"").decode("utf-8", "replace")
            self.files += self._name == "file"
        self._header.clear()
        self._value.clear()

    def _part_data(self, data: bytes, start: int, end: int) -> None:
        if self._name == "file" and self.files == 1:
            self.pending += data[start:end]
        elif self._name == "file":
            raise Problem(422, "file-repeated", compose("file-repeated"), [compose("field-file-repeated")])
        elif len(self._data) + end - start > FIELD_BYTES:
            fault = compose("form-field-too-long", field=f"{self._name!r:.80}", bytes=FIELD_BYTES)
            raise Problem(413, "field-too-large", fault)
        else:
            self._data += data[start:end]

    def _part_end(self) -> None:
        if self._name != "file":
            self.fields[self._name] = self._data.decode("utf-8", "replace")

    def _end(self) -> None:
        self.ended = True


def check_fields(names: Iterable[str], known: Collection[str]) -> None:
    """Raises InputError naming each field that is not in ``known``, with the nearest known name. Without this check a
    misspelt ``settings`` would be ignored."""
    faults = []
    for name in names:
        if name not in known:
            near = suggest(name, known)
            field = f"{name!r:.80}"
            faults.append(
                compose("form-field-unknown-near", field=field, near=f"{near[0]!r}")
                if near
                else compose("form-field-unknown", field=field, known=known)
            )
    if faults:
        raise InputError("form", faults)


async def receive_capture(
    service: Service, request: Request, key: str, known: Collection[str] = ABOUT
) -> tuple[CaptureRecord, dict[str, str]]:
    """Receives an archive in a multipart body and makes a capture of it. ``key`` is the id of the caller's API key.
    Returns the capture's record and the form's fields.

    Raises InputError for fields that are not in ``known`` and for faults of the archive, and what ``receive_multipart``
    and ``Captures.accept`` raise.
    """
    await service.threads.disk(check_length, request, service.store, service.settings)
    with service.store.incoming() as folder:
        archive, fields = await receive_multipart(request, folder, service.store, service.settings, service.threads)
        check_fields(fields, known)
        about, hung_up = CaptureMetadata.of(fields), partial(await_hang_up, request.receive)
        record = await service.threads.check(service.captures.accept, archive, folder, about, key=key, hung_up=hung_up)
    return record, fields


async def receive_calibration_pictures(service: Service, request: Request, key: str) -> CalibrationOut:
    """Receives an archive in a multipart body and queues a calibration. ``key`` is the caller's. The archive holds
    IMAGES/ and board.toml or, if the field ``from`` is ``scene``, photographs. Raises InputError naming every fault,
    and what ``receive_multipart`` raises."""
    await service.threads.disk(check_length, request, service.store, service.settings)
    with service.store.incoming() as folder:
        archive, fields = await receive_multipart(request, folder, service.store, service.settings, service.threads)
        check_fields(fields, ("label", "from"))
        label = (fields.get("label") or "")[:500]
        source = fields.get("from") or "board"
        if source not in ("board", "scene"):
            fault = compose("field-from-unknown", value=f"{source!r:.80}")
            raise Problem(422, "invalid-request", compose("calibration-source-unknown"), [fault])
        hung_up = partial(await_hang_up, request.receive)
        accept = partial(service.accept_pictures, source)
        return await service.threads.check(accept, archive, folder, label, key=key, hung_up=hung_up)
