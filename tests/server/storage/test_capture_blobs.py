"""Files of captures in a store: each content once, whole or unseen, gone with its last capture whoever removes it."""

import threading
from collections.abc import Callable
from dataclasses import replace
from pathlib import Path

import pytest
import sqlalchemy as sa

from rig.files import sha256_of
from server.errors import Conflict
from server.services.retention import collect
from server.settings import ServiceSettings
from server.storage.capture_blobs import NAME, SMALL_BYTES, CaptureBlobs, open_capture_blobs
from server.storage.database import capture_index, open_database
from server.storage.objects import FolderObjects, StoreUnavailable
from server.storage.store import new_id
from tests.server.storage.test_records import in_parallel

PICTURE = b"a picture" * SMALL_BYTES


@pytest.fixture
def bucket(tmp_path: Path) -> FolderObjects:
    (tmp_path / "nas").mkdir()
    return FolderObjects(tmp_path / "nas")


@pytest.fixture
def settings(tmp_path: Path, bucket: FolderObjects) -> ServiceSettings:
    return ServiceSettings(data=tmp_path / "data", captures_store=f"file://{tmp_path}/nas/")


@pytest.fixture
def blobs(settings: ServiceSettings) -> CaptureBlobs:
    return opened(settings)


def opened(settings: ServiceSettings) -> CaptureBlobs:
    found = open_capture_blobs(settings, open_database(settings))
    assert found is not None
    return found


def written(folder: Path, **contents: bytes) -> dict[str, str]:
    folder.mkdir(exist_ok=True)
    for name, content in contents.items():
        (folder / name).write_bytes(content)
    return {name: sha256_of(folder / name) for name in contents}


def any_size(size: int) -> None:
    pass


def names(bucket: FolderObjects) -> list[str]:
    return [name for name in bucket.folders() if NAME.fullmatch(name)]


def test_equal_contents_are_stored_once_and_go_with_the_last_capture(
    blobs: CaptureBlobs, bucket: FolderObjects, tmp_path: Path
) -> None:
    one, other = new_id(), new_id()
    first = written(tmp_path / "one", cameras=b"{}", left=PICTURE, right=PICTURE, plate=b"plate")
    second = written(tmp_path / "other", cameras=b"{}", left=PICTURE + b"2", plate=b"plate")
    blobs.keep(one, tmp_path / "one", first)
    assert len(names(bucket)) == 3
    sent = blobs.objects.operations()["put", "done"]
    blobs.keep(other, tmp_path / "other", second)
    assert blobs.objects.operations()["put", "done"] == sent + 1
    assert len(names(bucket)) == 4
    blobs.release(one)
    assert blobs.files(one) == {}
    blobs.restore(other, tmp_path / "fetched", None, any_size)
    assert {path.name: path.read_bytes() for path in (tmp_path / "fetched").iterdir()} == {
        "cameras": b"{}", "left": PICTURE + b"2", "plate": b"plate",
    }  # fmt: skip
    blobs.release(other)
    assert names(bucket) == []


def test_what_is_fetched_is_compared(blobs: CaptureBlobs, tmp_path: Path) -> None:
    capture, folder = new_id(), tmp_path / "fetched"
    inputs = written(tmp_path / "mine", left=PICTURE, features=b"[1]")
    blobs.keep(capture, tmp_path / "mine", inputs)
    blobs.restore(capture, folder, inputs, any_size)
    (folder / "features").write_bytes(b"[2]")  # small files are compared each time
    blobs.restore(capture, folder, inputs, any_size)
    assert (folder / "features").read_bytes() == b"[1]"
    (folder / "left").unlink()
    (stored,) = (tmp_path / "nas").glob(f"{inputs['left']}-*/content")
    stored.write_bytes(PICTURE[:-1] + b"!")
    with pytest.raises(StoreUnavailable):
        blobs.restore(capture, folder, inputs, any_size)
    stored.unlink()
    with pytest.raises(Conflict):
        blobs.restore(capture, folder, inputs, any_size)
    assert [path.name for path in folder.iterdir()] == ["features"]


def test_captures_are_unseen_until_whole(blobs: CaptureBlobs, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    capture = new_id()
    inputs = written(tmp_path / "mine", a=b"1", b=b"2", c=b"3")
    put, done = FolderObjects.put, []

    def second_fails(self: FolderObjects, key: str, path: Path, sha256: str) -> None:
        if len(done) == 2:
            raise StoreUnavailable("nas", "gone")
        done.append(key)
        put(self, key, path, sha256)

    monkeypatch.setattr(FolderObjects, "put", second_fails)
    assert not blobs.offer(capture, tmp_path / "mine", inputs)
    assert blobs.files(capture) == {}
    monkeypatch.setattr(FolderObjects, "put", put)
    assert blobs.offer(capture, tmp_path / "mine", inputs)
    assert {*blobs.files(capture)} == {*inputs}
    assert len({blob.id for blob in blobs.files(capture).values()} & {key.split("/")[0] for key in done}) == 2


def test_a_store_that_is_away_lets_erasing_be_repeated(blobs: CaptureBlobs, tmp_path: Path) -> None:
    capture = new_id()
    blobs.keep(capture, tmp_path / "mine", written(tmp_path / "mine", left=PICTURE))
    (tmp_path / "nas").rename(tmp_path / "away")
    with pytest.raises(StoreUnavailable):
        blobs.release(capture)
    (tmp_path / "away").rename(tmp_path / "nas")
    again = new_id()
    blobs.keep(again, tmp_path / "mine", written(tmp_path / "mine", left=PICTURE))  # not the dead one
    blobs.release(capture)
    blobs.restore(again, tmp_path / "fetched", None, any_size)
    assert (tmp_path / "fetched" / "left").read_bytes() == PICTURE


def test_a_capture_that_is_erased_while_it_is_stored_leaves_nothing(
    blobs: CaptureBlobs, bucket: FolderObjects, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    capture, put = new_id(), FolderObjects.put

    def erased_before(self: FolderObjects, key: str, path: Path, sha256: str) -> None:
        blobs.release(capture)
        put(self, key, path, sha256)

    monkeypatch.setattr(FolderObjects, "put", erased_before)
    blobs.keep(capture, tmp_path / "mine", written(tmp_path / "mine", left=PICTURE))
    assert names(bucket) == []
    assert blobs.files(capture) == {}


def test_two_services_come_and_go_at_once(
    settings: ServiceSettings, blobs: CaptureBlobs, bucket: FolderObjects, tmp_path: Path
) -> None:
    inputs = written(tmp_path / "mine", left=PICTURE, plate=b"plate")
    stop, wrong = threading.Event(), list[str]()

    def come_and_go(service: CaptureBlobs, number: int) -> Callable[[], None]:
        def rounds() -> None:
            try:
                for step in range(8):
                    capture, target = new_id(), tmp_path / f"fetched{number}-{step}"
                    service.keep(capture, tmp_path / "mine", inputs)
                    service.restore(capture, target, None, any_size)
                    if (target / "left").read_bytes() != PICTURE:
                        wrong.append(capture)
                    service.release(capture)
            finally:
                stop.set()

        return rounds

    def collects() -> None:
        while not stop.is_set():
            collect(bucket, "mine", blobs.known, 1.0, tmp_path, NAME.fullmatch)
            blobs.bury()

    in_parallel(*(come_and_go(opened(settings), number) for number in range(2)), collects)
    assert not wrong
    blobs.bury()
    assert names(bucket) == []


def test_what_a_killed_service_left_goes(blobs: CaptureBlobs, bucket: FolderObjects, tmp_path: Path) -> None:
    inputs = written(tmp_path / "mine", left=PICTURE)
    old, late = f"{1:012x}" + "0" * 16, new_id()
    for capture in (old, late):
        blobs._claim(capture, inputs, len)  # as far as a kill let it come
    blobs.release_abandoned()
    assert blobs.holders([old, late]) == {late}
    stray = f"{'0' * 64}-{'1' * 16}"
    bucket.put(f"{stray}/content", tmp_path / "mine" / "left", inputs["left"])
    assert collect(bucket, "mine", blobs.known, 1.0, tmp_path, NAME.fullmatch) == 0
    assert collect(bucket, "mine", blobs.known, 0.0, tmp_path, NAME.fullmatch) == 1


def test_captures_of_before_wait_for_the_store(blobs: CaptureBlobs, settings: ServiceSettings, tmp_path: Path) -> None:
    engine, captures = open_database(settings), sorted(new_id() for _ in range(3))
    columns = {"label": "", "verdict": "", "source": "", "board": False, "bytes": 1, "words": "", "changed": 0}
    with engine.begin() as connection:
        connection.execute(sa.insert(capture_index), [{"id": capture} | columns for capture in captures])
    assert blobs.waiting(2) == captures[:2]
    blobs.keep(captures[0], tmp_path / "mine", written(tmp_path / "mine", left=b"1"))
    assert blobs.waiting(5) == captures[1:]
    assert blobs.is_known(captures[1])
    assert not blobs.is_known(new_id())
    blob = blobs.files(captures[0])["left"]
    assert replace(blob, id="") == replace(blob, id="", stored=True)
