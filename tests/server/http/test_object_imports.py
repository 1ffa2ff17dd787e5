"""Captures that come from an object store: only from where the operator allowed, whole, and a store that is away is a
503 that says when to ask again."""

from collections.abc import Iterator
from typing import Any

import httpx
import pytest

from tests.support.object_server import KEYS, Network, client_of
from tests.support.services import RunningService, imported, packed_capture, running_service


@pytest.fixture(scope="module")
def bucket(object_server: str, tmp_path_factory: pytest.TempPathFactory) -> Any:
    """A client of the studio's own: its bucket holds one capture as an archive, and as a folder."""
    client, folder = client_of(object_server, "studio-in"), tmp_path_factory.mktemp("studio")
    archive = packed_capture(folder)
    client.put_object(Bucket="studio-in", Key="in/anna.tar", Body=archive.read_bytes())
    client.put_object(Bucket="studio-in", Key="secret/anna.tar", Body=archive.read_bytes())
    for file in (path for path in (folder / "capture0").rglob("*") if path.is_file()):
        key = f"in/anna/{file.relative_to(folder / 'capture0').as_posix()}"
        client.put_object(Bucket="studio-in", Key=key, Body=file.read_bytes())
    return client


@pytest.fixture(scope="module")
def service(way: Network, tmp_path_factory: pytest.TempPathFactory) -> Iterator[RunningService]:
    folder = tmp_path_factory.mktemp("service")
    packed_capture(folder)
    with running_service(
        folder / "data",
        worker=False,
        variables=KEYS,
        import_prefixes=f'["s3://studio-in/in/", "file://{folder}/"]',
        store_endpoint=way.url,
        store_timeout_s="0.6",
        body_bytes=str(1 << 20),
    ) as service:
        yield service


@pytest.mark.parametrize("url", ["s3://studio-in/in/anna.tar", "s3://studio-in/in/anna/", "file://{0}/capture0.tar"])
def test_a_capture_in_a_store_becomes_one_here(url: str, service: RunningService) -> None:
    made = imported(service, url.format(service.data.parent))
    assert made.status_code == 201, made.text
    capture = httpx.get(service.url + made.headers["location"]).json()
    assert (capture["label"], len(capture["cameras"])) == ("Anna", 3)
    assert {"cameras.json", "images/cam00.png"} <= {*capture["inputs"]}


@pytest.mark.parametrize(
    ("url", "status", "kind"),
    [
        ("s3://studio-in/secret/anna.tar", 422, "url-refused"),
        ("s3://studio-in/in/../secret/anna.tar", 422, "url-refused"),
        ("file:///etc/passwd", 422, "url-refused"),
        ("s3://studio-in/in/nobody.tar", 422, "object-missing"),
        ("s3://studio-in/in/nobody/", 422, "object-missing"),
        ("s3://studio-in/in/", 422, "invalid-capture"),
    ],
)
def test_what_is_not_allowed_or_not_there_is_refused(url: str, status: int, kind: str, service: RunningService) -> None:
    answer = imported(service, url)
    assert (answer.status_code, answer.json()["type"]) == (status, f"urn:eigenhead:problem:{kind}"), answer.text
    assert not [*(service.data / "incoming").iterdir()]


def test_what_is_too_large_is_not_fetched(service: RunningService, bucket: Any, way: Network) -> None:
    bucket.put_object(Bucket="studio-in", Key="in/large.tar", Body=bytes(2 << 20))
    answer = imported(service, "s3://studio-in/in/large.tar")
    assert (answer.status_code, answer.json()["type"]) == (413, "urn:eigenhead:problem:upload-too-large")


@pytest.mark.parametrize("fault", ["503", "silent", "torn", "flipped"])
def test_an_absent_store_is_a_503_and_the_next_call_passes(fault: Any, service: RunningService, way: Network) -> None:
    way.fail(fault, 1000, "GET")
    answer = imported(service, "s3://studio-in/in/anna.tar")
    way.heal()
    assert answer.status_code == 503, answer.text
    assert answer.json()["type"] == "urn:eigenhead:problem:store-unavailable"
    assert answer.headers["retry-after"] == "10"
    assert imported(service, "s3://studio-in/in/anna.tar").status_code == 201
    way.fail(fault, 1, "GET")
    assert imported(service, "s3://studio-in/in/anna.tar").status_code == 201
    way.heal()
