"""A worker with a data folder of its own has captures from the store, waits for them, and forgets what is erased."""

import os
import threading
import time
from collections.abc import Callable
from dataclasses import replace
from pathlib import Path

import pytest

from rig.errors import Cancelled
from rig.files import sha256_of
from server.services.failures import JobFailed
from server.services.stored_captures import bound_captures, forget_erased
from server.settings import ServiceSettings
from server.storage.capture_blobs import open_capture_blobs
from server.storage.database import open_database
from server.storage.library import Library
from server.storage.records import CaptureRecord
from server.storage.store import Store, new_id
from server.worker.capture_source import CaptureSource
from tests.support.stored_captures import stored_files

PICTURE = os.urandom(1 << 17)


@pytest.fixture
def settings(tmp_path: Path) -> ServiceSettings:
    (tmp_path / "nas").mkdir()
    place = f"file://{tmp_path}/nas/"
    database = f"sqlite:///{tmp_path}/jobs.sqlite"
    return ServiceSettings(
        data=tmp_path / "own",
        captures_store=place,
        results_store=f"{place}results/",
        database_url=database,
        free_bytes=0,
    )


def opened(settings: ServiceSettings, data: Path, *, serves: bool) -> Store:
    engine = open_database(settings)
    return Store(data, Library(engine) if serves else None, open_capture_blobs(settings, engine))


@pytest.fixture
def served(settings: ServiceSettings, tmp_path: Path) -> Store:
    return opened(settings, tmp_path / "service", serves=True)


@pytest.fixture
def remote(settings: ServiceSettings) -> Store:
    return opened(settings, settings.data, serves=False)


def source(remote: Store, settings: ServiceSettings, runs: Callable[[str], bool] = bool) -> CaptureSource:
    return CaptureSource(remote, settings, runs, threading.Event())


@pytest.fixture
def captures(remote: Store, settings: ServiceSettings) -> CaptureSource:
    return source(remote, settings)


def taken(store: Store) -> CaptureRecord:
    with store.incoming() as files:
        (files / "cameras.json").write_bytes(b"{}")
        (files / "cam00.png").write_bytes(PICTURE)
        return store.capture(stored_files(store, files))


def test_files_come_from_the_store_and_new_feature_points_too(served: Store, captures: CaptureSource) -> None:
    record = taken(served)
    captures.check(record.id)
    with captures.files("job", record.id) as folder:
        assert {path.name: path.read_bytes() for path in folder.iterdir()} == {
            "cam00.png": PICTURE, "cameras.json": b"{}",
        }  # fmt: skip
    points = served.folder("captures", record.id) / "files" / "features.json"
    for content in (b"[1]", b"[2]"):
        points.write_bytes(content)
        inputs = {**record.inputs, "features.json": sha256_of(points)}
        served.change_capture(record.id, lambda old, inputs=inputs: replace(old, inputs=inputs))
        with captures.files("job", record.id) as folder:
            assert (folder / "features.json").read_bytes() == content


def test_captures_on_the_way_are_awaited(
    settings: ServiceSettings, served: Store, remote: Store, tmp_path: Path
) -> None:
    (tmp_path / "nas").rename(tmp_path / "away")
    record, questions = taken(served), list[str]()

    def mends(job_id: str) -> bool:
        questions.append(job_id)
        if len(questions) == 2:
            (tmp_path / "away").rename(tmp_path / "nas")
            served.share(record)
        return True

    with source(remote, settings, mends).files("job", record.id) as folder:
        assert (folder / "cam00.png").read_bytes() == PICTURE
    assert questions == ["job"] * 2


def test_a_cancelled_job_waits_no_more(settings: ServiceSettings, served: Store, remote: Store, tmp_path: Path) -> None:
    record = taken(served)
    (tmp_path / "nas").rename(tmp_path / "away")
    with pytest.raises(Cancelled), source(remote, settings, lambda _: False).files("job", record.id):
        pass


def test_a_capture_that_is_nowhere_fails_its_job(served: Store, captures: CaptureSource, tmp_path: Path) -> None:
    record = taken(served)
    with pytest.raises(JobFailed) as failed:
        captures.check(new_id())
    assert failed.value.kind == "not-found"
    for path in (tmp_path / "nas").glob("*/content"):
        path.unlink()
    with pytest.raises(JobFailed) as failed, captures.files("job", record.id):
        pass
    assert failed.value.kind == "capture-missing"


def test_what_is_erased_goes_from_a_workers_own_folder(served: Store, remote: Store, captures: CaptureSource) -> None:
    erased, other = taken(served), taken(served)
    for record in (erased, other):
        with captures.files("job", record.id):
            remote.cache_of(record.id).mkdir(parents=True)
    served.remove_capture(erased.id)
    assert forget_erased(remote) == 1
    assert forget_erased(served) == 0
    assert remote.ids("captures") == remote.ids("cache/captures") == [other.id]


def test_results_leave_a_folder_of_the_worker(settings: ServiceSettings, served: Store, remote: Store) -> None:
    record, job = taken(served), new_id()
    for store in (served, remote):
        (store.folder("jobs", job) / "result").mkdir(parents=True)
        source(store, settings).leave(job, record.id)
    assert [store.folder("jobs", job).exists() for store in (served, remote)] == [True, False]


def test_files_that_were_not_used_for_long_go_and_come_back(served: Store) -> None:
    old, used, needed = (taken(served) for _ in range(3))
    for record in (old, needed):
        long_ago = time.time() - 7200
        os.utime(served.folder("captures", record.id) / "files", (long_ago, long_ago))
    assert bound_captures(served, 1 << 40, lambda _: False) == 0
    assert bound_captures(served, 0, lambda identity: identity == needed.id) == 1
    left = [(served.folder("captures", record.id) / "files" / "cam00.png").exists() for record in (old, used, needed)]
    assert left == [False, True, True]
    assert (served.capture_files(old.id) / "cam00.png").read_bytes() == PICTURE


def test_a_capture_that_is_stored_again_while_it_is_erased_leaves_nothing(
    settings: ServiceSettings, served: Store, monkeypatch: pytest.MonkeyPatch
) -> None:
    record, blobs = taken(served), served.blobs
    assert blobs is not None
    bury = blobs.bury

    def stored_again() -> int:
        monkeypatch.undo()
        buried = bury()
        served.share(record)
        return buried

    monkeypatch.setattr(blobs, "bury", stored_again)
    served.remove_capture(record.id)
    assert blobs.holders([record.id]) == set()
    other = taken(served)
    served.share(record)  # a sweep that read the record before; the other has the same contents
    served.remove_capture(other.id)
    assert [*(settings.data.parent / "nas").glob("*/content")] == []
