"""Resumable uploads on disk: what is promised, what expires, and one writer at a time."""

import time
from dataclasses import replace
from pathlib import Path

import pytest

from server.errors import Conflict, DiskFull, NotFound, TooLarge, TooMany
from server.services.uploads import ResumableUploads, too_large
from server.settings import ServiceSettings
from server.storage.store import Store, new_id

FREE = 1000


@pytest.fixture
def store(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Store:
    store = Store(tmp_path / "data")
    monkeypatch.setattr(Store, "free_bytes", lambda self: FREE)
    return store


def uploads(store: Store, **settings: float) -> ResumableUploads:
    values = {"body_bytes": 400, "free_bytes": 100, "upload_hours": 2.0} | settings
    return ResumableUploads(store, ServiceSettings.model_validate({"data": store.data, **values}))


def test_an_announced_upload_is_empty_and_belongs_to_its_key(store: Store) -> None:
    some = uploads(store)
    before = time.time()
    record = some.create(40, {"label": "Anna"}, "key1")
    assert (record.length, record.fields, record.key, record.capture) == (40, {"label": "Anna"}, "key1", None)
    assert before + 7200 <= record.expires <= time.time() + 7200
    assert some.get(record.id) == record
    assert some.data(record) == store.data / "uploads" / record.id / "data"
    assert some.offset(record) == 0
    some.data(record).write_bytes(b"x" * 7)
    assert some.offset(record) == 7


def test_it_may_be_as_large_as_the_limit_and_no_larger(store: Store) -> None:
    some = uploads(store)
    assert some.create(400, {}, "key").length == 400
    with pytest.raises(TooLarge, match="400 bytes") as refused:
        some.create(401, {}, "key")
    assert refused.value.kind == too_large(ServiceSettings(data=store.data)).kind == "upload-too-large"


def test_a_key_has_so_many_unfinished_uploads_and_no_more(store: Store) -> None:
    some = uploads(store, uploads_per_key=2)
    first, _, _ = (some.create(10, {}, key) for key in ("a", "a", "b"))
    with pytest.raises(TooMany, match="2 uploads of this key"):
        some.create(10, {}, "a")
    some.save(replace(first, capture=new_id()))
    assert some.create(10, {}, "a")


def test_room_is_kept_for_what_others_were_promised(store: Store) -> None:
    """900 bytes may be taken, and each upload needs room twice, packed and unpacked, but once what is on its way."""
    some = uploads(store)
    first = some.create(300, {}, "a")  # 600
    with pytest.raises(DiskFull):
        some.create(301, {}, "b")  # 602 + 300
    second = some.create(300, {}, "b")  # 600 + 300: to the last byte
    some.remove(second.id)
    some.data(first).write_bytes(b"x" * 299)
    assert some.create(400, {}, "c").length == 400  # 800 + 1
    with pytest.raises(DiskFull):
        some.create(250, {}, "d")  # 500 + 1 + 400
    some.save(replace(first, capture=new_id()))  # a finished one brings nothing more
    assert some.create(250, {}, "d").length == 250  # 500 + 400


def test_once_the_capture_was_made_all_bytes_are_here(store: Store) -> None:
    some = uploads(store)
    record = replace(some.create(40, {}, "key"), capture=new_id())
    some.save(record)
    some.data(record).unlink()
    assert some.offset(some.get(record.id)) == 40


def test_what_is_no_upload_is_not_found(store: Store) -> None:
    some = uploads(store)
    damaged = some.create(40, {}, "key")
    (store.data / "uploads" / damaged.id / "upload.json").write_text("{")
    for identity in (damaged.id, new_id(), "../sessions", "x"):
        with pytest.raises(NotFound, match=f"There is no upload '{identity}'"):
            some.get(identity)
    strange = store.data / "uploads" / new_id()  # neither takes part in what was promised
    strange.mkdir()
    assert some.create(400, {}, "key").length == 400


def test_what_expired_is_swept_and_nothing_else(store: Store) -> None:
    some = uploads(store)
    kept, old, older = (some.create(40, {}, "key") for _ in range(3))
    for record in (old, older):
        some.save(replace(record, expires=time.time() - 1))
    strange = store.data / "uploads" / new_id()  # somebody else's folder
    strange.mkdir()
    with pytest.raises(NotFound):
        some.get(old.id)
    with some.lock(old.id):
        assert some.sweep() == 1, "somebody still writes to the other"
    assert some.sweep() == 1
    assert sorted(path.name for path in (store.data / "uploads").iterdir()) == sorted([kept.id, strange.name])
    assert some.sweep() == 0
    assert some.get(kept.id) == kept


def test_one_writer_at_a_time(store: Store) -> None:
    some = uploads(store)
    record = some.create(40, {}, "key")
    with some.lock(record.id):
        with pytest.raises(Conflict, match="Another request") as refused, some.lock(record.id):
            raise AssertionError("two writers")
        assert refused.value.kind == "upload-busy"
        with some.lock(some.create(40, {}, "key").id):
            pass
    with some.lock(record.id):
        pass


def test_what_was_removed_meanwhile_is_not_locked(store: Store) -> None:
    some = uploads(store)
    record = some.create(40, {}, "key")
    some.remove(record.id)
    with pytest.raises(NotFound), some.lock(record.id):
        raise AssertionError("nothing is there")
