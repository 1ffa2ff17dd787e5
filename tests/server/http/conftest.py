"""The service that the tests of HTTP speak to."""

from collections.abc import Iterator

import httpx
import pytest

from server.cli.client import Client
from tests.support.services import RunningService, packed, running_service, small_capture, upload


@pytest.fixture(scope="session")
def service(tmp_path_factory: pytest.TempPathFactory) -> Iterator[RunningService]:
    """One for all files of this folder that bring none of their own."""
    with running_service(tmp_path_factory.mktemp("service") / "data") as running:
        yield running


@pytest.fixture
def client(service: RunningService) -> Iterator[Client]:
    with Client(service.url) as client:
        yield client


@pytest.fixture
def capture(http: httpx.Client, archive: bytes) -> str:
    """The id of a capture that was uploaded for this test."""
    return upload(http, archive).json()["id"]


@pytest.fixture(scope="session")
def archive(tmp_path_factory: pytest.TempPathFactory) -> bytes:
    return packed(small_capture(tmp_path_factory.mktemp("archive") / "capture"))
