"""JSON bodies before FastAPI reads them: whose they are, and how much of them is taken; and answers to uploads that are
refused before they were read, as a proxy meets them: it writes first and reads later."""

import asyncio
import json
import socket
from collections.abc import AsyncIterator, Iterator
from dataclasses import dataclass
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import httpx
import pytest
from fastapi import FastAPI, Request
from fastapi.routing import APIRoute
from pydantic import BaseModel
from starlette.types import Message, Receive, Scope, Send

from server.http.app import DrainRequestBody, JsonBodies
from server.services.keys import Keys
from server.settings import ServiceSettings
from server.storage.database import open_database
from tests.support.services import RunningService

MOST = 1000
PIECE = 100
BYTES = 8 << 20  # more than both sockets hold: some of it is still to be written when the answer is out


class Note(BaseModel):
    text: str


@dataclass
class Door:
    """An app of a route with a JSON body, one that streams and a mounted page, and a key to it."""

    app: FastAPI
    key: str

    def ask(
        self,
        path: str,
        body: bytes,
        *,
        key: str | None = None,
        announced: int | None = None,
        kind: str = "application/json",
    ) -> tuple[int, bytes, int]:
        """The status and body of the answer, and how many bytes were read for it. The client never goes away."""
        return asyncio.run(self._ask(path, body, key, announced, kind))

    async def _ask(
        self, path: str, body: bytes, key: str | None, announced: int | None, kind: str
    ) -> tuple[int, bytes, int]:
        read = 0

        async def pieces() -> AsyncIterator[bytes]:
            nonlocal read
            for start in range(0, len(body), PIECE):
                read += len(body[start : start + PIECE])
                yield body[start : start + PIECE]

        headers = {"content-type": kind}
        headers |= {} if key is None else {"authorization": f"Bearer {key}"}
        headers |= {} if announced is None else {"content-length": str(announced)}
        transport = httpx.ASGITransport(self.app)
        async with httpx.AsyncClient(transport=transport, base_url="http://127.0.0.1") as client:
            answer = await client.post(path, content=pieces(), headers=headers)
        return answer.status_code, answer.content, read


@pytest.fixture
def door(tmp_path: Path) -> Iterator[Door]:
    settings = ServiceSettings(data=tmp_path)
    engine = open_database(settings)
    keys = Keys(engine)
    app = FastAPI()

    @app.post("/notes")
    async def note(wanted: Note) -> int:
        return len(wanted.text)

    @app.post("/streams")
    async def stream(request: Request) -> int:
        return len(await request.body())

    pages = FastAPI()
    pages.add_api_route("/notes", note, methods=["POST"])
    app.mount("/pages", pages)
    app.state.service = SimpleNamespace(keys=keys, settings=settings)
    app.add_middleware(JsonBodies, routes=[r for r in app.routes if isinstance(r, APIRoute)], most=MOST)
    yield Door(app, keys.add("console", ("read",)))
    engine.dispose()


def note_of(length: int) -> bytes:
    """A JSON body of ``length`` bytes."""
    return json.dumps({"text": "x" * (length - 12)}).encode()


@pytest.mark.parametrize(("key", "kind"), [(None, "key-missing"), ("eh_000000000000_wrong", "key-invalid")])
def test_nobody_is_refused_before_a_byte_is_read(door: Door, key: str | None, kind: str) -> None:
    status, body, read = door.ask("/notes", bytes(100 * MOST), key=key)
    assert (status, json.loads(body)["type"].rpartition(":")[2], read) == (401, kind, 0)


@pytest.mark.parametrize(("announced", "read_most"), [(MOST + 1, 0), (None, MOST + PIECE), (10, MOST + PIECE)])
def test_no_more_is_read_than_a_json_body_may_have(door: Door, announced: int | None, read_most: int) -> None:
    status, body, read = door.ask("/notes", note_of(100 * MOST), key=door.key, announced=announced)
    assert (status, json.loads(body)["type"]) == (413, "urn:eigenhead:problem:body-too-large")
    assert read <= read_most


@pytest.mark.parametrize("kind", ["multipart/form-data; boundary=x", "Multipart/Mixed"])
def test_a_form_is_told_where_archives_go_before_a_byte_is_read(door: Door, kind: str) -> None:
    status, body, read = door.ask("/notes", bytes(100 * MOST), key=door.key, announced=100 * MOST, kind=kind)
    assert (status, read) == (415, 0)
    assert "POST /v1/captures/uploads" in json.loads(body)["detail"]
    assert door.ask("/notes", bytes(100 * MOST), kind=kind)[0] == 401  # nobody is told nothing
    assert door.ask("/streams", bytes(3 * PIECE), kind=kind)[0] == 200


@pytest.mark.parametrize("length", [20, PIECE, MOST - 1, MOST])
@pytest.mark.parametrize("announces", [True, False])
def test_a_body_up_to_the_limit_arrives_whole(door: Door, length: int, announces: bool) -> None:
    sent = note_of(length)
    answer = door.ask("/notes", sent, key=door.key, announced=len(sent) if announces else None)
    assert answer == (200, str(length - 12).encode(), length)


@pytest.mark.parametrize(("path", "body"), [("/streams", b"5000"), ("/pages/notes", b"4988")])
def test_what_streams_and_pages_have_their_own_rules(door: Door, path: str, body: bytes) -> None:
    assert door.ask(path, note_of(5 * MOST)) == (200, body, 5 * MOST)


@pytest.mark.parametrize("path", ["/v1/reconstructions", "/v1/captures/uploads", "/v1/nowhere"])
def test_who_is_still_writing_gets_the_answer(service: RunningService, path: str) -> None:
    head = f"POST {path} HTTP/1.1\r\nHost: 127.0.0.1:{service.port}\r\nConnection: close\r\n"
    head += f"Content-Type: text/plain\r\nContent-Length: {BYTES}\r\n\r\n"
    with socket.create_connection(("127.0.0.1", service.port), timeout=30) as client:
        client.sendall(head.encode() + bytes(BYTES))  # raises where the service reset the connection
        answer = b"".join(iter(lambda: client.recv(1 << 16), b""))
    headers, body = answer.split(b"\r\n\r\n", 1)
    assert int(headers.split()[1]) == (404 if "nowhere" in path else 415)
    assert json.loads(body)["detail"]


def test_who_writes_without_end_is_hung_up_on() -> None:
    sent = asyncio.run(_sent_to(more=True, body=b"refused", linger_s=0.05))
    assert [message.get("body", b"") for message in sent] == [b"", b"refused", b""]
    assert [message.get("more_body", False) for message in sent[1:]] == [True, False]


def test_a_request_that_was_read_is_answered_as_it_is() -> None:
    sent = asyncio.run(_sent_to(more=False, body=b"done", linger_s=60.0))
    assert [message.get("more_body", False) for message in sent] == [False, False]


async def _sent_to(*, more: bool, body: bytes, linger_s: float) -> list[Message]:
    """What a server is sent for a request of whose body ``more`` comes for ever."""
    sent: list[Message] = []

    async def app(scope: Scope, receive: Receive, send: Send) -> None:
        await receive()
        await send({"type": "http.response.start", "status": 422, "headers": []})
        await send({"type": "http.response.body", "body": body})

    async def receive() -> Message:
        await asyncio.sleep(0.001)
        return {"type": "http.request", "body": b"x", "more_body": more}

    async def send(message: Message) -> None:
        sent.append(message)

    scope: dict[str, Any] = {"type": "http", "http_version": "1.1"}
    scope["headers"] = [(b"connection", b"close"), (b"content-length", b"1000000")]
    await DrainRequestBody(app, patience_s=0.05, linger_s=linger_s)(scope, receive, send)
    return sent
