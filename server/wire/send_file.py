"""Sends files of known content, with ETag, If-None-Match and single byte ranges."""

import hashlib
import io
import mimetypes
import re
import zipfile
from collections.abc import Iterator, Mapping, Sequence
from pathlib import Path
from typing import Any

import structlog
from fastapi import Request, Response
from fastapi.responses import FileResponse, StreamingResponse

from rig.messages.message import compose
from server.storage.records import FileEntry
from server.storage.store import StoredFile
from server.wire.problems import Problem

TYPES = {
    ".ply": "application/octet-stream",
    ".glb": "model/gltf-binary",
    ".obj": "model/obj",
    ".mtl": "model/mtl",
    ".stl": "model/stl",
    ".usdz": "model/vnd.usdz+zip",
    ".3mf": "model/3mf",
}
BLOCK_BYTES = 1 << 20
RANGE = re.compile(r"^bytes=(\d{1,18})?-(\d{1,18})?$")

log = structlog.get_logger()


def send_file(request: Request, file: StoredFile) -> Response:
    """Returns the response that carries a file: status 200, 206 for one byte range, or 304 if the client has it
    already.

    Raises a 416 problem for a range beyond the file, 404 if the file is missing, and 500 if its content has changed.
    Other forms of the Range header are ignored, as RFC 9110 allows.
    """
    path, etag = file.path, f'"{file.sha256}"'
    if not path.is_file():
        raise Problem(404, "not-found", compose("file-gone"))
    _refuse_damaged([file])
    headers = {"ETag": etag, "Cache-Control": "private, no-cache", "X-Content-Type-Options": "nosniff"}
    if _is_at_client(request, etag):
        return Response(status_code=304, headers=headers)
    _check_range(request, path.stat().st_size)
    return FileResponse(path, headers=headers, media_type=media_type(path.name))


def send_archive(
    request: Request, folder: Path, files: Mapping[str, FileEntry], name: str | None = "result.zip"
) -> Response:
    """Returns the response that carries the named files below ``folder`` as one uncompressed .zip, or 304 if the client
    has it already. The .zip contains no times, so that equal files give equal bytes.

    ``name`` is the file name that a browser suggests. With None the page's link decides. Raises a 500 problem that
    names every file whose content is not what was stored.
    """
    _refuse_damaged([StoredFile(folder / name, file["sha256"]) for name, file in files.items()])
    digest = hashlib.sha256("\n".join(f"{name} {file['sha256']}" for name, file in files.items()).encode()).hexdigest()
    headers = {"ETag": f'"{digest}"', "Cache-Control": "private, no-cache", "X-Content-Type-Options": "nosniff"}
    headers["Content-Disposition"] = "attachment" if name is None else f'attachment; filename="{name}"'
    if _is_at_client(request, headers["ETag"]):
        return Response(status_code=304, headers=headers)
    blocks = () if request.method == "HEAD" else _zipped(folder, list(files))
    return StreamingResponse(blocks, headers=headers, media_type="application/zip")  # its length is not known yet


def send_zip(data: bytes) -> Response:
    """Returns the response that carries a .zip made for this request."""
    headers = {"Cache-Control": "no-store", "Content-Disposition": "attachment"}
    return Response(data, headers=headers, media_type="application/zip")


def _refuse_damaged(files: Sequence[StoredFile]) -> None:
    damaged = [file.path.name for file in files if not file.is_intact()]
    if damaged:
        log.error("files are damaged", files=[str(file.path) for file in files if file.path.name in damaged])
        raise Problem(500, "file-damaged", compose("file-damaged", files=damaged))


def _is_at_client(request: Request, etag: str) -> bool:
    """Returns whether If-None-Match names the file, whose tag compressing proxies mark as weak (RFC 9110, 13.1.2)."""
    held = re.split(r"\s*,\s*", request.headers.get("if-none-match", ""))
    return held == ["*"] or etag in (tag.removeprefix("W/") for tag in held)


def _zipped(folder: Path, names: list[str]) -> Iterator[bytes]:
    sent = _Sent()
    with zipfile.ZipFile(sent, "w", zipfile.ZIP_STORED) as archive:
        for name in names:
            with (folder / name).open("rb") as source, archive.open(zipfile.ZipInfo(name), "w") as target:
                while block := source.read(BLOCK_BYTES):
                    target.write(block)
                    yield sent.take()
    yield sent.take()


class _Sent(io.RawIOBase):
    """Collects the bytes that the zip writer wrote and that are not sent yet. The class cannot seek, so zipfile writes
    a stream."""

    def __init__(self) -> None:
        self._pending = bytearray()

    def writable(self) -> bool:
        return True

    def write(self, data: Any, /) -> int:
        self._pending += data
        return len(data)

    def take(self) -> bytes:
        data, self._pending = bytes(self._pending), bytearray()
        return data


def media_type(name: str) -> str:
    """Returns the media type of a file by its suffix; ``application/octet-stream`` if it is unknown."""
    suffix = Path(name).suffix
    return TYPES.get(suffix) or mimetypes.guess_type(name)[0] or "application/octet-stream"


def _check_range(request: Request, size: int) -> None:
    text = request.headers.get("range")
    if text is None:
        return
    match = RANGE.match(text)
    first, last = match.groups() if match else (None, None)
    if (first is None and last is None) or (first and last and int(first) > int(last)):
        request.scope["headers"] = [(name, value) for name, value in request.scope["headers"] if name != b"range"]
    elif (first is not None and int(first) >= size) or (first is None and int(last or 0) == 0):
        raise Problem(
            416,
            "range-not-satisfiable",
            compose("range-outside", bytes=size),
            headers={"Content-Range": f"bytes */{size}"},
        )
