"""Multipart bodies as they come over the wire, in pieces of any size: what is taken, and what is refused by name."""

import asyncio
from pathlib import Path
from types import SimpleNamespace
from typing import Any, cast

import pytest
from fastapi import Request

from rig.errors import EigenheadError
from server.errors import DiskFull, TooLarge
from server.services.threads import Threads
from server.settings import ServiceSettings
from server.storage.store import Store
from server.wire.multipart import FIELD_BYTES, check_length, described_form, receive_multipart
from server.wire.problems import Problem

DATA = bytes(range(256)) * 40
TYPE = "multipart/form-data; boundary=edge"


def part(name: str, data: bytes, more: str = "") -> bytes:
    head = f'--edge\r\nContent-Disposition: form-data; name="{name}"{more}\r\n\r\n'
    return head.encode() + data + b"\r\n"


def body(*parts: bytes) -> bytes:
    return b"".join(parts) + b"--edge--\r\n"


def received(
    folder: Path, data: bytes, content_type: str = TYPE, piece: int = 1000, **settings: int
) -> tuple[bytes, dict[str, str]]:
    """What ``receive_multipart`` makes of a body that comes in pieces."""

    async def stream() -> Any:
        for start in range(0, len(data), piece):
            yield data[start : start + piece]

    async def receive() -> tuple[Path, dict[str, str]]:
        request = cast(Request, SimpleNamespace(headers={"content-type": content_type}, stream=stream))
        return await receive_multipart(
            request, folder, ServiceSettings.model_validate({"data": folder, **settings}), Threads()
        )

    path, fields = asyncio.run(receive())
    return path.read_bytes(), fields


@pytest.mark.parametrize("piece", [1, 7, 1000, 1 << 20])
def test_file_and_fields_arrive_whole_in_pieces_of_any_size(tmp_path: Path, piece: int) -> None:
    sent = body(part("label", "Änna".encode()), part("file", DATA, '; filename="a.tar"'), part("session", b""))
    assert received(tmp_path, sent, piece=piece) == (DATA, {"label": "Änna", "session": ""})


def test_a_large_file_is_written_on_the_way(tmp_path: Path) -> None:
    large = DATA * 300  # 3 MB: several blocks
    assert received(tmp_path, body(part("file", large)), piece=100_000)[0] == large


@pytest.mark.parametrize(
    ("data", "content_type", "status", "kind"),
    [
        (b"{}", "application/json", 415, "unsupported-media-type"),
        (body(part("file", DATA)), "multipart/form-data", 415, "unsupported-media-type"),
        (body(part("file", DATA)), "multipart/form-data; boundary=" + "x" * 300, 400, "malformed-body"),
        (b"no boundary here", TYPE, 400, "malformed-body"),
        (part("file", DATA), TYPE, 400, "malformed-body"),
        (body(part("file", DATA))[:500], TYPE, 400, "malformed-body"),
        (body(part("label", b"Anna")), TYPE, 422, "file-missing"),
        (body(part("file", DATA), part("file", DATA)), TYPE, 422, "file-repeated"),
        (body(part("file", DATA), part("label", b"x" * (FIELD_BYTES + 1))), TYPE, 413, "field-too-large"),
    ],
)
def test_what_is_no_such_body_is_refused(
    tmp_path: Path, data: bytes, content_type: str, status: int, kind: str
) -> None:
    with pytest.raises(Problem) as refused:
        received(tmp_path, data, content_type)
    assert (refused.value.status, refused.value.kind) == (status, kind)


def test_a_field_may_be_as_long_as_the_limit(tmp_path: Path) -> None:
    sent = body(part("file", DATA), part("label", b"x" * FIELD_BYTES))
    assert received(tmp_path, sent)[1] == {"label": "x" * FIELD_BYTES}


def test_a_body_may_have_as_many_bytes_as_the_limit_and_no_more(tmp_path: Path) -> None:
    sent = body(part("file", DATA))
    assert received(tmp_path, sent, body_bytes=len(sent))[0] == DATA
    (tmp_path / "upload").unlink()
    with pytest.raises(TooLarge, match=f"{len(sent) - 1:,} bytes"):
        received(tmp_path, sent, body_bytes=len(sent) - 1)


@pytest.mark.parametrize(
    ("announced", "error"),
    [(None, None), ("450", None), ("451", DiskFull), ("500", DiskFull), ("501", TooLarge), ("-3", None), ("x", None)],
)
def test_the_announced_length_is_judged(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, announced: str | None, error: type[EigenheadError] | None
) -> None:
    """900 bytes may be taken; packed and unpacked make it twice. What is no number is judged as it comes."""
    monkeypatch.setattr(Store, "free_bytes", lambda self: 1000)
    settings = ServiceSettings(data=tmp_path, body_bytes=500, free_bytes=100)
    request = cast(Request, SimpleNamespace(headers={} if announced is None else {"content-length": announced}))
    if error is None:
        check_length(request, Store(tmp_path), settings)
        return
    with pytest.raises(error):
        check_length(request, Store(tmp_path), settings)


def test_a_form_is_described(tmp_path: Path) -> None:
    described = described_form("an archive", ("label",), settings="JSON object")
    schema = described["requestBody"]["content"]["multipart/form-data"]["schema"]
    assert described["requestBody"]["required"]
    assert schema == {
        "type": "object",
        "required": ["file"],
        "properties": {
            "file": {"type": "string", "format": "binary", "description": "an archive"},
            "label": {"type": "string"},
            "settings": {"type": "string", "description": "JSON object"},
        },
    }
