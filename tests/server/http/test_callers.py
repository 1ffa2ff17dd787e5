"""Who a request without a key is from: people at the machine, or a foreign page that made their browser send it."""

from types import SimpleNamespace

import httpx
import pytest
from fastapi import Request

from server.http.auth import require
from server.settings import ServiceSettings
from server.wire.problems import Problem
from tests.support.services import RunningService


def ask(service: RunningService, **sent: str) -> httpx.Response:
    """What only an administrator may ask, with these headers."""
    return httpx.get(service.url + "/v1/keys", headers=sent, timeout=60)


@pytest.mark.parametrize("host", ["127.0.0.1:8600", "localhost:8600", "[::1]:8600"])
def test_without_keys_people_at_the_machine_may_all(service: RunningService, host: str) -> None:
    assert ask(service, host=host).json() == {"keys": []}


@pytest.mark.parametrize(
    "origin", ["http://localhost:3000", "http://127.0.0.1:8600", "http://localhost", "https://[::1]:1"]
)
def test_pages_of_this_machine_may_ask(service: RunningService, origin: str) -> None:
    assert ask(service, origin=origin).status_code == 200


@pytest.mark.parametrize(
    "sent",
    [
        {"host": "evil.example"},
        {"origin": "http://evil.example"},
        {"origin": "https://evil.example:8600"},
        {"origin": "http://localhost.evil.example"},
        {"origin": "http://evil.example://localhost"},
        {"origin": "null"},
        {"host": "evil.example", "origin": "http://localhost"},
    ],
)
def test_what_a_foreign_page_made_a_browser_send_is_refused(service: RunningService, sent: dict[str, str]) -> None:
    refused = ask(service, **sent)
    assert (refused.status_code, refused.json()["type"]) == (403, "urn:eigenhead:problem:foreign-origin")
    assert refused.json()["detail"].startswith("Without API keys the service answers only to its own machine; make a")


def test_behind_a_proxy_a_key_is_needed_from_the_first_request_on() -> None:
    service = SimpleNamespace(settings=ServiceSettings(public_url="https://heads.example"))
    app = SimpleNamespace(state=SimpleNamespace(service=service))
    with pytest.raises(Problem) as refused:
        require("read")(Request({"type": "http", "headers": [], "app": app}), None)
    assert (refused.value.status, refused.value.kind) == (401, "key-missing")
