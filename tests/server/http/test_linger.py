"""Answers to uploads that are refused before they were read, as a proxy meets them: it writes first and reads later."""

import asyncio
import json
import socket
from typing import Any

import pytest
from starlette.types import Message, Receive, Scope, Send

from server.http.app import DrainRequestBody
from tests.support.services import RunningService

BYTES = 8 << 20  # more than both sockets hold: some of it is still to be written when the answer is out


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
