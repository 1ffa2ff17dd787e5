"""A service whose store lies behind a way that tests cut; ``bucket`` and ``service`` are each file's own."""

from collections.abc import Iterator
from typing import Any

import httpx
import pytest

from tests.support.object_server import Network, network_before
from tests.support.services import RunningService, uploaded_capture


@pytest.fixture(scope="module")
def way(bucket: Any, object_server: str) -> Iterator[Network]:
    with network_before(object_server) as network:
        yield network


@pytest.fixture(scope="module")
def capture(service: RunningService) -> str:
    return uploaded_capture(service, service.data.parent)


@pytest.fixture
def client(service: RunningService, way: Network) -> Iterator[httpx.Client]:
    with httpx.Client(base_url=service.url, timeout=60) as client:
        yield client
    way.heal()
