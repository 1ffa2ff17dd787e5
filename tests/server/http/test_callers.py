"""Who a request is from, rule by rule: the same function that every operation asks."""

from collections.abc import Iterator
from pathlib import Path
from types import SimpleNamespace

import pytest
from fastapi import Request
from fastapi.security import HTTPAuthorizationCredentials

from server.http.auth import require
from server.services.keys import SCOPES, Caller, Keys
from server.settings import ServiceSettings
from server.storage.database import open_database
from server.wire.problems import Problem

ALL = frozenset(SCOPES)


class Door:
    """Asks ``require`` as FastAPI does, of a service that has these keys and settings."""

    def __init__(self, keys: Keys, settings: ServiceSettings) -> None:
        self.keys = keys
        self._app = SimpleNamespace(state=SimpleNamespace(service=SimpleNamespace(keys=keys, settings=settings)))

    def ask(
        self, scope: str = "read", token: str | None = None, host: str = "127.0.0.1:8600", **headers: str
    ) -> Caller:
        sent = [(b"host", host.encode()), *((name.encode(), value.encode()) for name, value in headers.items())]
        request = Request(
            {
                "type": "http",
                "method": "GET",
                "path": "/v1/jobs",
                "query_string": b"",
                "scheme": "http",
                "server": ("127.0.0.1", 8600),
                "headers": sent,
                "app": self._app,
            }
        )
        credentials = None if token is None else HTTPAuthorizationCredentials(scheme="Bearer", credentials=token)
        return require(scope)(request, credentials)

    def refusal(self, *args: str, **kwargs: str) -> tuple[int, str, str, str]:
        with pytest.raises(Problem) as caught:
            self.ask(*args, **kwargs)
        problem = caught.value
        return (
            problem.status,
            problem.kind,
            problem.detail.text,
            dict(problem.headers or {}).get("WWW-Authenticate", ""),
        )


@pytest.fixture
def door(tmp_path: Path) -> Iterator[Door]:
    settings = ServiceSettings(data=tmp_path)
    engine = open_database(settings)
    yield Door(Keys(engine), settings)
    engine.dispose()


@pytest.mark.parametrize("host", ["127.0.0.1:8600", "localhost:8600", "[::1]:8600"])
@pytest.mark.parametrize("scope", sorted(ALL))
def test_without_keys_people_at_the_machine_may_all(door: Door, scope: str, host: str) -> None:
    assert door.ask(scope, host=host) == Caller("local", ALL)


@pytest.mark.parametrize(
    "origin", ["http://localhost:3000", "http://127.0.0.1:8600", "http://localhost", "https://[::1]:1"]
)
def test_pages_of_this_machine_may_ask(door: Door, origin: str) -> None:
    assert door.ask(origin=origin).key == "local"


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
def test_what_a_foreign_page_made_a_browser_send_is_refused(door: Door, sent: dict[str, str]) -> None:
    status, kind, detail, _ = door.refusal(**sent)
    assert (status, kind) == (403, "foreign-origin")
    assert detail.startswith("Without API keys the service answers only to its own machine; make a key")


def test_once_there_is_a_key_it_is_needed(door: Door) -> None:
    token = door.keys.add("lab", ("read",))
    assert door.refusal()[:2] == (401, "key-missing")
    assert door.ask(token=token, host="heads.example", origin="http://evil.example").may("read")  # no cookie to steal


def test_behind_a_proxy_a_key_is_needed_from_the_first_request_on(door: Door, tmp_path: Path) -> None:
    public = Door(door.keys, ServiceSettings(data=tmp_path, public_url="https://heads.example"))
    assert public.refusal()[:2] == (401, "key-missing")
