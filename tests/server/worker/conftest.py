"""A service whose store lies behind a way that tests cut; ``bucket`` and ``service`` are each file's own."""

from collections.abc import Iterator

import httpx
import pytest

from tests.support.object_server import Network
from tests.support.services import RunningService, uploaded_capture


@pytest.fixture(scope="module")
def capture(service: RunningService) -> str:
    return uploaded_capture(service, service.data.parent)


@pytest.fixture
def client(service: RunningService, way: Network) -> Iterator[httpx.Client]:
    with httpx.Client(base_url=service.url, timeout=60) as client:
        yield client
    way.heal()
