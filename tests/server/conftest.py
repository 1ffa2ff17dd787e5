"""How tests of the service start processes, and the object server that they share; the product is imported after the
hook that checks shapes."""

import subprocess
from collections.abc import Iterator
from typing import TYPE_CHECKING

import pytest

if TYPE_CHECKING:
    from tests.support.object_server import Network


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


@pytest.fixture(scope="session")
def object_server() -> Iterator[str]:
    from tests.support.object_server import running_object_server

    with running_object_server() as url:
        yield url


@pytest.fixture
def network(object_server: str, monkeypatch: pytest.MonkeyPatch) -> "Iterator[Network]":
    """The way to the server, with the keys in the environment."""
    from tests.support.object_server import KEYS, network_before

    for name, value in KEYS.items():
        monkeypatch.setenv(name, value)
    with network_before(object_server) as network:
        yield network
