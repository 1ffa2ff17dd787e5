"""Multipart bodies as they come over the wire, in pieces of any size: what is taken, and what is refused by name."""

import asyncio
from pathlib import Path
from types import SimpleNamespace
from typing import Any, cast

import pytest
from fastapi import Request

from rig.errors import EigenheadError, InputError
from rig.messages.message import texts_of
from server.errors import DiskFull, TooLarge
from server.services.threads import Threads
from server.settings import ServiceSettings
from server.storage.store import Store
from server.wire.multipart import BLOCK_BYTES, FIELD_BYTES, FIELDS_MOST, check_fields, check_length, receive_multipart
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
        service_settings = ServiceSettings.model_validate({"data": folder, "free_bytes": 0, **settings})
        return await receive_multipart(request, folder, Store(folder), service_settings, Threads())

    path, fields = asyncio.run(receive())
    return path.read_bytes(), fields


@pytest.mark.parametrize("piece", [1, 7, 1000, 1 << 20])
def test_file_and_fields_arrive_whole_in_pieces_of_any_size(tmp_path: Path, piece: int) -> None:
    sent = body(part("label", "Änna".encode()), part("file", DATA, '; filename="a.tar"'), part("session", b""))
    assert received(tmp_path, sent, piece=piece) == (DATA, {"label": "Änna", "session": ""})


def test_a_large_file_is_written_on_the_way(tmp_path: Path) -> None:
    large = DATA * 300  # 3 MB: several blocks
    assert received(tmp_path, body(part("file", large)), piece=100_000)[0] == large


def test_a_client_that_vanished_is_given_up(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr("server.wire.multipart.IDLE_TIMEOUT_S", 0.05)

    async def stream() -> Any:
        yield part("file", DATA)
        await asyncio.sleep(60)

    request = cast(Request, SimpleNamespace(headers={"content-type": TYPE}, stream=stream))
    with pytest.raises(Problem, match=r"Nothing more came for 0\.05 s") as refused:
        asyncio.run(receive_multipart(request, tmp_path, Store(tmp_path), ServiceSettings(data=tmp_path), Threads()))
    assert (refused.value.status, refused.value.kind) == (408, "body-silent")


FILE, TWICE = part("file", DATA), part("file", DATA) * 2
LONG = part("label", b"x" * (FIELD_BYTES + 1))
CUT = "malformed-body: The multipart body breaks off before its end; send it again."
REFUSED: dict[str, tuple[bytes, str, int, str, str]] = {
    "JSON": (b"{}", "application/json", 415, "unsupported-media-type: Send multipart/form-data with the archive", ""),
    "no boundary": (body(FILE), "multipart/form-data", 415, "unsupported-media-type: Send multipart/form-data", ""),
    "a long one": (body(FILE), TYPE + "x" * 300, 400, "malformed-body: The multipart boundary is no good (", ""),
    "not in the body": (b"nowhere", TYPE, 400, "malformed-body: The body is no multipart/form", ""),
    "a long header": (body(part("x" * 5000, b"")), TYPE, 400, "malformed-body: The body is no multipart/form-data", ""),
    "no end": (FILE, TYPE, 400, CUT, ""),
    "cut": (body(FILE)[:500], TYPE, 400, CUT, ""),
    "no file": (body(part("label", b"")), TYPE, 422, "file-missing: The form has no part 'file' with", "file: missing"),
    "two": (body(TWICE), TYPE, 422, "file-repeated: The form has several parts 'file'; send one", "file: repeated"),
    "a field": (body(FILE, LONG), TYPE, 413, "field-too-large: The form field 'label' is longer than 65,536 bytes", ""),
}


@pytest.mark.parametrize(("data", "content_type", "status", "said", "fault"), REFUSED.values(), ids=REFUSED.keys())
def test_what_is_no_such_body_is_refused(
    tmp_path: Path, data: bytes, content_type: str, status: int, said: str, fault: str
) -> None:
    with pytest.raises(Problem) as refused:
        received(tmp_path, data, content_type)
    problem = refused.value
    assert (problem.status, " ".join(texts_of(problem.errors))) == (status, fault)
    assert f"{problem.kind}: {problem.detail}".startswith(said)


def test_a_form_may_have_a_hundred_parts_and_no_more(tmp_path: Path) -> None:
    """Of one name, too: what is counted is what comes."""
    fields = [part("label", b"x") for _ in range(FIELDS_MOST - 1)]
    assert received(tmp_path, body(*fields, part("file", DATA)))[0] == DATA
    (tmp_path / "upload").unlink()
    with pytest.raises(Problem, match="more than 100 parts") as refused:
        received(tmp_path, body(*fields, part("file", DATA), part("label", b"x")))
    assert (refused.value.status, refused.value.kind) == (413, "fields-too-many")


def test_a_body_that_announced_nothing_leaves_the_spare_room(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """Of five blocks of room two are to be spared."""
    room = 5 * BLOCK_BYTES
    written = tmp_path / "upload"
    monkeypatch.setattr(Store, "free_bytes", lambda self: room - written.stat().st_size)
    blocks = body(part("file", bytes(9 * BLOCK_BYTES)))
    with pytest.raises(DiskFull):
        received(tmp_path, blocks, piece=BLOCK_BYTES // 4, free_bytes=2 * BLOCK_BYTES)
    assert 2 * BLOCK_BYTES < written.stat().st_size <= 3 * BLOCK_BYTES


@pytest.mark.parametrize(
    ("sent", "fields"),
    [
        (  # no UTF-8: taken with a mark
            b'--edge\r\nContent-Disposition: form-data; name="l\xffabel"\r\n\r\n\xfeAnna\r\n',
            {"l\ufffdabel": "\ufffdAnna"},
        ),
        (  # without a name it is no file
            b"--edge\r\nContent-Disposition: form-data\r\n\r\nx\r\n--edge\r\nContent-Type: text/plain\r\n\r\ny\r\n",
            {"": "y"},
        ),
        (  # headers beside the disposition name nothing
            b'--edge\r\nX-First: a; name="b"\r\nContent-Disposition: form-data; name="label"\r\n'
            b'X-Last: c; name="d"\r\n\r\nAnna\r\n',
            {"label": "Anna"},
        ),
        (part("label", b"x" * FIELD_BYTES), {"label": "x" * FIELD_BYTES}),  # as long as the limit
    ],
)
def test_fields_are_named_by_their_disposition_alone(tmp_path: Path, sent: bytes, fields: dict[str, str]) -> None:
    assert received(tmp_path, body(sent, part("file", DATA)), piece=3) == (DATA, fields)


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


def test_each_field_that_a_form_does_not_have_is_named() -> None:
    check_fields(["label", "settings"], ("label", "settings"))
    with pytest.raises(InputError) as refused:
        check_fields(["settigns", "label", "webhook", ""], ("label", "settings"))
    assert texts_of(refused.value.faults) == [
        "unknown field 'settigns'; did you mean 'settings'?",
        "unknown field 'webhook'; there are file, label, settings",
        "unknown field ''; there are file, label, settings",
    ]
