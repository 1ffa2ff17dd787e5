"""The client against a service that answers by a script: what it waits for, and for how long."""

from collections.abc import Callable, Iterator

import httpx
import pytest

from server.cli.client import Client, ServiceError, Unreachable
from tests.support.services import small_capture

PATIENCE_S = 0.7
END = b'event: end\nid: 2\ndata: {"state": "succeeded"}\n\n'


def client_of(answer: Callable[[httpx.Request], httpx.Response]) -> Client:
    client = Client("http://service", patience_s=PATIENCE_S)
    client._http = httpx.Client(base_url="http://service", transport=httpx.MockTransport(answer))
    return client


class Broken(httpx.SyncByteStream):
    """A body that ends in a broken connection."""

    def __iter__(self) -> Iterator[bytes]:
        yield b'event: progress\nid: 1\ndata: {"state": "running", "stage": "fit", "progress": 0.5}\n\n'
        raise httpx.ReadError("cut off")


def test_events_go_on_across_broken_connections_and_busy_answers() -> None:
    requested: list[str] = []

    def answer(request: httpx.Request) -> httpx.Response:
        requested.append(request.headers["last-event-id"])
        replies = [httpx.Response(200, stream=Broken()), httpx.Response(503), httpx.Response(200, content=END)]
        return replies[len(requested) - 1]

    with client_of(answer) as client:
        assert [kind for kind, _ in client.events("job")] == ["progress", "end"]
    assert requested == ["0", "1", "1"]


@pytest.mark.parametrize("reply", [httpx.Response(503), httpx.ConnectError("nobody there")])
def test_a_service_that_never_answers_is_given_up(reply: httpx.Response | httpx.ConnectError) -> None:
    def answer(request: httpx.Request) -> httpx.Response:
        if isinstance(reply, Exception):
            raise reply
        return reply

    with client_of(answer) as client, pytest.raises(Unreachable):
        list(client.events("job"))


def test_an_upload_that_stands_still_is_given_up(tmp_path) -> None:
    def answer(request: httpx.Request) -> httpx.Response:
        if request.method == "POST":
            return httpx.Response(201, headers={"location": "/v1/uploads/1"})
        return httpx.Response(429 if request.method == "PATCH" else 200, headers={"upload-offset": "0"})

    with client_of(answer) as client, pytest.raises(ServiceError, match="stands still at 0 bytes"):
        client.upload(small_capture(tmp_path / "capture"))
