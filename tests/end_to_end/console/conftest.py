"""The service whose pages are looked at."""

from collections.abc import Iterator
from pathlib import Path

import pytest

from tests.support.services import RunningService, running_service


@pytest.fixture
def service(tmp_path: Path) -> Iterator[RunningService]:
    """The tiny work: what is looked at here is the pages."""
    with running_service(tmp_path / "data", console="true") as running:
        yield running
