"""How tests of the service start processes, and the object server that they share; the product is imported after the
hook that checks shapes."""

import subprocess
from collections.abc import Iterator
from typing import TYPE_CHECKING

import httpx
import pytest

if TYPE_CHECKING:
    from tests.support.object_server import Network
    from tests.support.services import RunningService


@pytest.fixture(autouse=True)
def _forked_processes(request: pytest.FixtureRequest, monkeypatch: pytest.MonkeyPatch) -> None:
    """Commands of the product, workers and their children are forked from one process that has imported the product
    (``tests.support.fork_server``), but in tests with the fixture ``real_exec``."""
    from tests.support.fork_server import Popen

    if "real_exec" not in request.fixturenames:
        monkeypatch.setattr(subprocess, "Popen", Popen)


@pytest.fixture
def real_exec() -> None:
    """For tests of what the start of an interpreter does or costs."""


@pytest.fixture
def http(service: "RunningService") -> Iterator[httpx.Client]:
    """A client of the file's or the room's service."""
    with httpx.Client(base_url=service.url, timeout=120) as client:
        yield client


@pytest.fixture(scope="session")
def object_server() -> Iterator[str]:
    from tests.support.object_server import running_object_server

    with running_object_server() as url:
        yield url


@pytest.fixture(scope="module")
def way(bucket: object, object_server: str) -> "Iterator[Network]":
    """The way of a file's service to the server, on which the file's ``bucket`` is."""
    from tests.support.object_server import network_before

    with network_before(object_server) as network:
        yield network


@pytest.fixture
def network(object_server: str, monkeypatch: pytest.MonkeyPatch) -> "Iterator[Network]":
    """The way to the server, with the keys in the environment."""
    from tests.support.object_server import KEYS, network_before

    for name, value in KEYS.items():
        monkeypatch.setenv(name, value)
    with network_before(object_server) as network:
        yield network
