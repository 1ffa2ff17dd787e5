"""The service against its own description, by schemathesis; laboratory's `described_requests` asks for longer."""

from pathlib import Path

import pytest

from server.services.keys import SCOPES
from tests.support.attacks import add_keys
from tests.support.described import ask_as_described
from tests.support.services import running_service


@pytest.mark.slow
@pytest.mark.gl
@pytest.mark.timeout(900)
@pytest.mark.parametrize("scope", ["admin", *(pytest.param(s, marks=pytest.mark.nightly) for s in SCOPES[:-1])])
def test_schemathesis_finds_nothing(tmp_path: Path, scope: str) -> None:
    with running_service(tmp_path / "data") as service:
        done = ask_as_described(service, tmp_path, add_keys(service, scope)[0], "--max-examples", "3", "--seed", "1")
        assert done.returncode == 0, done.stdout[-8000:]
        assert "unforeseen" not in service.log.read_text()
