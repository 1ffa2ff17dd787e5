"""Results in the store that no job claims: they go when they are old, and nothing else does, whoever else collects."""

from collections.abc import Collection
from pathlib import Path

import pytest

from rig.files import sha256_of
from server.services.retention import OWNER, collect
from server.settings import ServiceSettings
from server.storage.database import database_identity, open_database
from server.storage.objects import FolderObjects
from server.storage.store import new_id
from tests.support.at_once import run_at_once


@pytest.fixture
def objects(tmp_path: Path) -> FolderObjects:
    (tmp_path / "nas").mkdir()
    return FolderObjects(tmp_path / "nas")


def stored(objects: FolderObjects, tmp_path: Path, job_id: str) -> str:
    (tmp_path / "head.ply").write_bytes(b"a head")
    for name in ("head.ply", "overlays/cam00.png"):
        objects.put(f"{job_id}/{name}", tmp_path / "head.ply", sha256_of(tmp_path / "head.ply"))
    return job_id


def test_only_what_is_old_and_unknown_goes(objects: FolderObjects, tmp_path: Path) -> None:
    claimed, stray = (stored(objects, tmp_path, new_id()) for _ in range(2))
    stored(objects, tmp_path, "somebody's own")

    def known(ids: Collection[str]) -> set[str]:
        return {claimed} & {*ids}

    assert collect(objects, "mine", known, 1.0, tmp_path) == 0, "a day old it is not"
    assert {*objects.folders()} == {claimed, stray, "somebody's own"}
    assert collect(objects, "mine", known, 0.0, tmp_path) == 1
    assert {*objects.folders()} == {claimed, "somebody's own"}


def test_another_database_collects_nothing(objects: FolderObjects, tmp_path: Path) -> None:
    stray = stored(objects, tmp_path, new_id())
    assert collect(objects, "mine", lambda ids: {*ids}, 0.0, tmp_path) == 0
    assert collect(objects, "another", lambda ids: set(), 0.0, tmp_path) == 0
    assert {*objects.folders()} == {stray}
    assert [entry.key for entry in objects.entries("") if "/" not in entry.key] == [OWNER]
    (tmp_path / "nas").rename(tmp_path / "away")
    assert collect(objects, "mine", lambda ids: set(), 0.0, tmp_path) == 0


def test_a_job_that_is_submitted_again_under_its_id_keeps_its_result(objects: FolderObjects, tmp_path: Path) -> None:
    again = stored(objects, tmp_path, new_id())
    answers = iter([set[str](), {again}])
    assert collect(objects, "mine", lambda ids: next(answers), 0.0, tmp_path) == 0
    assert {*objects.folders()} == {again}


def test_two_services_collect_at_once(objects: FolderObjects, tmp_path: Path) -> None:
    ids = [stored(objects, tmp_path, new_id()) for _ in range(40)]
    claimed = {*ids[::2]}
    run_at_once(lambda: collect(objects, "mine", lambda some: claimed & {*some}, 0.0, tmp_path))
    assert {*objects.folders()} == claimed


def test_a_database_names_itself_once(tmp_path: Path) -> None:
    names = set[str]()
    for data in ("one", "one", "other"):
        engine = open_database(ServiceSettings(data=tmp_path / data))
        names.add(database_identity(engine))
        engine.dispose()
    assert len(names) == 2
