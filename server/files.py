"""Sending a file of known content: ETag, If-None-Match, one byte range."""

import mimetypes
import re
from pathlib import Path

from fastapi import Request, Response
from fastapi.responses import FileResponse

from server.problems import Problem

TYPES = {".ply": "application/octet-stream", ".glb": "model/gltf-binary", ".obj": "model/obj"}
RANGE = re.compile(r"^bytes=(\d{1,18})?-(\d{1,18})?$")


def send_file(request: Request, path: Path, sha256: str) -> Response:
    """200, 206, 304 or a 416 problem. What is no single byte range is ignored, as RFC 9110 allows."""
    if not path.is_file():
        raise Problem(404, "not-found", "The file is not there any more.")
    etag = f'"{sha256}"'
    headers = {"ETag": etag, "Cache-Control": "private, no-cache", "X-Content-Type-Options": "nosniff"}
    if (
        etag in re.split(r"\s*,\s*", request.headers.get("if-none-match", ""))
        or request.headers.get("if-none-match") == "*"
    ):
        return Response(status_code=304, headers=headers)
    _check_range(request, path.stat().st_size)
    kind = TYPES.get(path.suffix) or mimetypes.guess_type(path.name)[0] or "application/octet-stream"
    return FileResponse(path, headers=headers, media_type=kind)


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
            416, "range-not-satisfiable", f"The file has {size} bytes.", headers={"Content-Range": f"bytes */{size}"}
        )
