"""The object server that tests of the service share; it is imported after the hook that checks shapes."""

from collections.abc import Iterator
from typing import TYPE_CHECKING

import pytest

if TYPE_CHECKING:
    from tests.support.object_server import Network


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
