"""Settings of the service: what older versions called things is still read."""

import pytest
from pydantic import ValidationError

from server.settings import RECONSTRUCT, ServiceSettings
from server.tasks.child import function_at
from server.tasks.reconstruct import reconstruct_capture


@pytest.mark.parametrize("address", ["server.work:reconstruct_capture", RECONSTRUCT])
def test_the_work_of_an_older_version_is_found(address: str, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setenv("EIGENHEAD_WORK", address)
    assert function_at(ServiceSettings().work) is reconstruct_capture


@pytest.mark.parametrize("url", ["heads.example", "https://heads.example/", "ftp://heads.example"])
def test_a_public_url_is_a_scheme_and_a_host(url: str) -> None:
    with pytest.raises(ValidationError):
        ServiceSettings(public_url=url)


def test_an_empty_variable_is_as_good_as_none(monkeypatch: pytest.MonkeyPatch) -> None:
    """Compose files pass variables on that nobody has set."""
    monkeypatch.setenv("EIGENHEAD_PUBLIC_URL", "")
    monkeypatch.setenv("EIGENHEAD_PORT", "")
    assert (ServiceSettings().public_url, ServiceSettings().port) == (None, 8600)
