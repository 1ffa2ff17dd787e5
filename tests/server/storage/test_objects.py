"""Objects in a folder and in a real S3 server: whole or not there, equal to what was stored or refused, gone with every
version. The network between loses, delays and changes what it is told to."""

import hashlib
import subprocess
import sys
import time
from pathlib import Path
from typing import Any

import httpx
import pytest

from server.errors import DiskFull, InvalidInput
from server.settings import ServiceSettings
from server.storage.object_places import key_faults, locate, open_objects
from server.storage.objects import ObjectMissing, ObjectStore, StoreDenied, StoreUnavailable
from server.wire.problems import problem_from
from tests.support.object_server import Network, client_of, with_keys
from tests.support.services import ROOT, await_true


@pytest.fixture(scope="module")
def bucket(object_server: str) -> Any:
    """A client that goes past the network, and a bucket with versions."""
    client = client_of(object_server, "studio")
    client.put_bucket_versioning(Bucket="studio", VersioningConfiguration={"Status": "Enabled"})
    client.put_object(Bucket="studio", Key="first", Body=b"makes the server take up its disk")
    return client


@pytest.fixture
def below(request: pytest.FixtureRequest) -> str:
    """Where in the bucket a test's objects lie."""
    return hashlib.sha256(request.node.name.encode()).hexdigest()[:12] + "/"


def settings_of(url: str, timeout_s: float = 1.0) -> ServiceSettings:
    return ServiceSettings(store_endpoint=url, store_timeout_s=timeout_s)


@pytest.fixture
def s3(network: Network, bucket: Any, below: str) -> ObjectStore:
    return open_objects(f"s3://studio/{below}", settings_of(network.url))


@pytest.fixture(params=["folder", "s3"])
def store(request: pytest.FixtureRequest, tmp_path: Path) -> ObjectStore:
    if request.param == "s3":
        return request.getfixturevalue("s3")
    (tmp_path / "nas").mkdir()
    return open_objects(f"file://{tmp_path}/nas/", ServiceSettings())


def made(tmp_path: Path, data: bytes, name: str = "head.ply") -> tuple[Path, str]:
    (tmp_path / name).write_bytes(data)
    return tmp_path / name, hashlib.sha256(data).hexdigest()


def no_room(size: int) -> None:
    assert size == 6
    raise DiskFull


def test_what_was_put_is_listed_fetched_and_erased(store: ObjectStore, tmp_path: Path) -> None:
    path, digest = made(tmp_path, b"a head")
    store.put("anna/overlays/cam 00 ä.png", path, digest)
    store.put("anna/head.ply", path, digest)
    store.put("annabel/head.ply", path, digest)
    assert sorted(entry.key for entry in store.entries("anna/")) == ["anna/head.ply", "anna/overlays/cam 00 ä.png"]
    assert store.fetch("anna/overlays/cam 00 ä.png", tmp_path / "back") == digest
    assert (tmp_path / "back").read_bytes() == b"a head"
    with pytest.raises(DiskFull):
        store.fetch("anna/head.ply", tmp_path / "large", admit=no_room)
    with pytest.raises(ObjectMissing):
        store.fetch("anna/none.ply", tmp_path / "none")
    with pytest.raises(StoreUnavailable):
        store.fetch("anna/head.ply", tmp_path / "other", "0" * 64)
    assert not any((tmp_path / name).exists() for name in ("large", "none", "other"))
    assert store.erase("anna/") == 2
    assert [(entry.key, entry.bytes) for entry in store.entries("")] == [("annabel/head.ply", 6)]


def test_folders_and_ages_are_listed(store: ObjectStore, tmp_path: Path) -> None:
    path, digest = made(tmp_path, b"a head")
    for key in ("owner", "anna/head.ply", "anna/overlays/cam00.png", "bert/head.ply"):
        store.put(key, path, digest)
    assert [*store.folders()] == ["anna", "bert"]
    assert all(abs(entry.written - time.time()) < 60 for entry in store.entries(""))


def test_a_link_gives_the_object_to_whoever_has_it(s3: ObjectStore, tmp_path: Path) -> None:
    path, digest = made(tmp_path, b"a head")
    s3.put("anna/head.ply", path, digest)
    link = s3.link("anna/head.ply", "head ä.ply", 60)
    assert link is not None
    answer = httpx.get(link)
    assert (answer.status_code, answer.content) == (200, b"a head")
    assert answer.headers["content-disposition"] == "attachment; filename*=UTF-8''head%20%C3%A4.ply"
    assert httpx.get(link.replace("head.ply", "none.ply")).status_code == 403
    with pytest.raises(ObjectMissing):
        s3.link("anna/none.ply", "none.ply", 60)
    (tmp_path / "nas").mkdir()
    assert open_objects(f"file://{tmp_path}/nas/", ServiceSettings()).link("anna/head.ply", "head.ply", 60) is None


def test_a_file_that_is_not_what_it_should_be_is_not_stored(store: ObjectStore, tmp_path: Path) -> None:
    for size in (100, 9 << 20):
        path, _ = made(tmp_path, bytes(size))
        with pytest.raises(StoreUnavailable):
            store.put("head.ply", path, "0" * 64)
    assert [*store.entries("")] == []


def test_a_folder_that_is_not_mounted_is_not_made(tmp_path: Path) -> None:
    path, digest = made(tmp_path, b"a head")
    store = open_objects(f"file://{tmp_path}/nas/", ServiceSettings())
    with pytest.raises(StoreUnavailable, match="mounted"):
        store.put("head.ply", path, digest)
    assert not (tmp_path / "nas").exists()
    (tmp_path / "nas").mkdir()
    (tmp_path / "nas" / "out").symlink_to("/etc")
    with pytest.raises(StoreDenied, match="leads out"):
        store.fetch("out/hostname", tmp_path / "stolen")
    with pytest.raises(StoreDenied):
        store.erase("")


@pytest.mark.parametrize("size", [100, (16 << 20) + 5])  # in one request, in three parts
@pytest.mark.parametrize("fault", ["503", "silent", "flipped"])
def test_a_passing_fault_is_outlasted(s3: ObjectStore, network: Network, tmp_path: Path, size: int, fault: Any) -> None:
    path, digest = made(tmp_path, hashlib.sha256(b"seed").digest() * (size // 32 + 1))
    network.fail(fault, 1, "PUT")
    s3.put("head.ply", path, digest)
    for again in (fault, "torn"):
        network.fail(again, 1, "GET", "head.ply")
        assert s3.fetch("head.ply", tmp_path / "back") == digest


@pytest.mark.parametrize("fault", ["503", "silent", "torn", "flipped"])
def test_a_store_that_stays_away_is_a_503_that_says_when_to_ask_again(
    s3: ObjectStore, below: str, network: Network, tmp_path: Path, fault: Any
) -> None:
    path, digest = made(tmp_path, b"a head of a hundred bytes" * 4)
    s3.put("head.ply", path, digest)
    hasty = open_objects(f"s3://studio/{below}", settings_of(network.url, 0.3))
    network.fail(fault, 1000, "GET", "head.ply")
    with pytest.raises(StoreUnavailable) as caught:
        hasty.fetch("head.ply", tmp_path / "back")
    problem = problem_from(caught.value)
    assert (problem.status, problem.kind, problem.headers) == (503, "store-unavailable", {"Retry-After": "10"})
    assert not (tmp_path / "back").exists()
    with pytest.raises(StoreUnavailable):  # what cannot be read back is not stored
        hasty.put("head.ply", path, digest)


def test_bytes_of_a_foreign_object_are_compared_with_what_the_store_says_of_them(
    s3: ObjectStore, bucket: Any, below: str, network: Network, tmp_path: Path
) -> None:
    """It has no SHA-256 of ours."""
    data = b"a picture of another program"
    bucket.put_object(Bucket="studio", Key=f"{below}cam00.png", Body=data)
    network.fail("flipped", 1, "GET", "cam00")
    assert s3.fetch("cam00.png", tmp_path / "back") == hashlib.sha256(data).hexdigest()
    assert (tmp_path / "back").read_bytes() == data


def test_an_equal_object_is_left_and_a_damaged_one_is_replaced(
    s3: ObjectStore, bucket: Any, below: str, network: Network, tmp_path: Path
) -> None:
    path, digest = made(tmp_path, b"a head")
    s3.put("head.ply", path, digest)
    network.seen.clear()
    s3.put("head.ply", path, digest)
    assert "PUT" not in {method for method, _ in network.seen}
    bucket.put_object(Bucket="studio", Key=f"{below}head.ply", Body=b"b head", Metadata={"sha256": digest})
    s3.put("head.ply", path, digest)
    assert s3.fetch("head.ply", tmp_path / "back") == digest


def test_erasing_takes_every_version_and_half_uploads(s3: ObjectStore, bucket: Any, below: str, tmp_path: Path) -> None:
    for text in (b"one", b"two", b"three"):
        s3.put("anna/head.ply", *made(tmp_path, text))
    bucket.delete_object(Bucket="studio", Key=f"{below}anna/head.ply")  # leaves a marker, and all three
    bucket.create_multipart_upload(Bucket="studio", Key=f"{below}anna/bust.ply")
    assert s3.erase("anna/") == 1
    left = bucket.list_object_versions(Bucket="studio", Prefix=f"{below}anna/")
    assert "Versions" not in left
    assert "DeleteMarkers" not in left
    assert not bucket.list_multipart_uploads(Bucket="studio", Prefix=f"{below}anna/").get("Uploads")


PUT = """
import hashlib, sys
from pathlib import Path
from server.settings import ServiceSettings
from server.storage.object_places import open_objects

store = open_objects(sys.argv[1], ServiceSettings(store_endpoint=sys.argv[2]))
path = Path(sys.argv[3])
store.put("head.ply", path, hashlib.sha256(path.read_bytes()).hexdigest())
"""


def test_a_kill_midway_is_unseen(s3: ObjectStore, bucket: Any, below: str, network: Network, tmp_path: Path) -> None:
    head, digest = made(tmp_path, bytes(20 << 20))
    network.plan = lambda method, path: "silent" if "partNumber=2" in path else None
    command = [sys.executable, "-c", PUT, f"s3://studio/{below}", network.url, str(head)]
    process = subprocess.Popen(command, cwd=ROOT, env=with_keys())
    await_true(lambda: any("partNumber=2" in path for _, path in network.seen))
    process.kill()
    assert process.wait() == -9
    network.heal()
    assert [*s3.entries("")] == []
    with pytest.raises(ObjectMissing):
        s3.fetch("head.ply", tmp_path / "back")
    assert (
        len(bucket.list_multipart_uploads(Bucket="studio", Prefix=below)["Uploads"]) == 1
    )  # sweeping it is the bucket's own rule
    s3.put("head.ply", head, digest)
    assert s3.fetch("head.ply", tmp_path / "back") == digest


def test_what_a_store_refuses_is_told(
    network: Network, bucket: Any, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    path, digest = made(tmp_path, b"a head")
    with pytest.raises(StoreDenied, match="NoSuchBucket"):
        open_objects("s3://nobody/", settings_of(network.url)).put("head.ply", path, digest)
    monkeypatch.setenv("AWS_SECRET_ACCESS_KEY", "another")
    denied = open_objects("s3://studio/heads/", ServiceSettings(store_endpoint=network.url, store_timeout_s=1.5))
    with pytest.raises(StoreDenied, match="403"):
        denied.put("head.ply", path, digest)


def test_only_what_lies_below_an_allowed_prefix_is_located() -> None:
    prefixes = ("s3://studio/in/", "s3://studio/in/raw/", "file:///srv/nas/")
    assert locate("s3://studio/in/raw/anna.tar", prefixes) == ("s3://studio/in/raw/", "anna.tar")
    assert locate("s3://studio/in/anna/", prefixes) == ("s3://studio/in/", "anna/")
    assert locate("file:///srv/nas/anna.tar", prefixes) == ("file:///srv/nas/", "anna.tar")
    refused = ["s3://studio/inner/a.tar", "s3://studio/in/../secret", "s3://studio/in//a", "file:///etc/passwd"]
    for url in [
        *refused,
        "s3://studio/in/a\n",
        "https://studio/in/",
        "s3://STUDIO/in/a",
        "s3://studio/in/" + 999 * "a",
    ]:
        with pytest.raises(InvalidInput) as caught:
            locate(url, prefixes)
        assert caught.value.kind == "url-refused"
    assert key_faults("a/./b")
    assert not key_faults("a/b/")
