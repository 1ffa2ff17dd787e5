"""``eigenhead doctor``: what it finds, and that it makes nothing."""

import shutil
from collections.abc import Callable
from pathlib import Path

import pytest
import sqlalchemy as sa

from server.cli import doctor
from server.services.job_rows import WORKFLOW
from server.services.jobs import migrate
from server.services.keys import Keys
from server.settings import ServiceSettings
from server.storage.database import open_database
from tests.support.object_server import Network, client_of


@pytest.fixture
def examine(monkeypatch: pytest.MonkeyPatch) -> Callable[..., dict]:
    """Without the two checks that load what is heavy."""
    for name in ("_egl", "_model"):
        monkeypatch.setattr(doctor, name, lambda settings: (True, "not looked at"))
    return lambda **overrides: doctor.examine(ServiceSettings(**overrides))


def test_it_shows_where_things_live_and_makes_nothing(
    examine: Callable[..., dict], tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.delenv("EIGENHEAD_MODELS", raising=False)
    monkeypatch.setenv("EIGENHEAD_DATA", str(tmp_path / "none" / "yet"))
    monkeypatch.setenv("EIGENHEAD_CACHE", str(tmp_path / "cache"))
    found = examine()
    assert found["data"]["ok"]
    for check, place in (("data", "none/yet"), ("models", "none/yet/models"), ("cache", "cache")):
        assert found[check]["detail"].startswith(str(tmp_path / place))
    for check in ("data", "database"):
        assert "will make it" in found[check]["detail"]
    assert list(tmp_path.iterdir()) == []


def test_it_reads_a_database_without_touching_the_folder(examine: Callable[..., dict], tmp_path: Path) -> None:
    engine = open_database(ServiceSettings(data=tmp_path))
    Keys(engine).add("console", ("read",))
    engine.dispose()
    before = sorted(tmp_path.iterdir())
    assert f"{tmp_path}, 0 workers seen in the last 15 s, 1 API key" in examine(data=tmp_path)["database"]["detail"]
    assert sorted(tmp_path.iterdir()) == before
    (tmp_path / "eigenhead.sqlite").write_bytes(b"no database" * 1000)
    assert not examine(data=tmp_path)["database"]["ok"]


def test_it_names_misspelt_variables_and_a_missing_rig_file(
    examine: Callable[..., dict], tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setenv("EIGENHEAD_KEEP_JOB", "3")
    found = examine(data=tmp_path, rig=tmp_path / "rig.toml")
    assert not found["variables"]["ok"]
    assert "EIGENHEAD_KEEP_JOB is not known; did you mean EIGENHEAD_KEEP_JOBS?" in found["variables"]["detail"]
    assert not found["rig"]["ok"]
    assert "rig.toml: the file cannot be read" in found["rig"]["detail"]


def test_it_judges_the_threads(examine: Callable[..., dict], tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setenv("EIGENHEAD_THREADS", "97")
    found = examine(data=tmp_path)
    assert found["variables"]["ok"]
    assert "EIGENHEAD_THREADS gives a job's loops 97 threads" in found["cores"]["detail"]
    monkeypatch.setenv("EIGENHEAD_THREADS", "many")
    found = examine(data=tmp_path)
    assert not found["cores"]["ok"]
    assert "EIGENHEAD_THREADS: the variable is 'many'; give a whole number from 1 to 512" in found["cores"]["detail"]


def test_captures_without_their_database_are_told(examine: Callable[..., dict], tmp_path: Path) -> None:
    """A copy of a data folder that lacks the database looks like a new one otherwise."""
    for name in ("captures/a", "captures/b", "jobs/c"):
        (tmp_path / name).mkdir(parents=True)
    found = examine(data=tmp_path)
    assert "2 captures, 1 jobs" in found["data"]["detail"]
    assert not found["database"]["ok"]
    assert "captures and jobs are" in found["database"]["detail"]


def test_a_result_that_is_gone_is_told(examine: Callable[..., dict], tmp_path: Path) -> None:
    """Jobs as the engine keeps them, written by its own tables; the folder of one was removed."""
    settings = ServiceSettings(data=tmp_path)
    assert examine(data=tmp_path)["results"] == {"ok": True, "detail": "none yet"}
    migrate(settings)
    kept, gone = "a" * 28, "b" * 28
    engine = open_database(settings)
    with engine.begin() as connection:
        for job, status in ((kept, "SUCCESS"), (gone, "SUCCESS"), ("c" * 28, "ERROR")):
            row = {"workflow_uuid": job, "status": status, "name": WORKFLOW}
            names = ", ".join(row)
            connection.execute(sa.text(f"INSERT INTO workflow_status ({names}) VALUES (:{', :'.join(row)})"), row)
    engine.dispose()
    for job in (kept, gone):
        (tmp_path / "jobs" / job / "result").mkdir(parents=True)
    all_there = {"ok": True, "detail": "of 2 jobs, all there; the files of 0 were compared"}
    assert examine(data=tmp_path)["results"] == all_there
    shutil.rmtree(tmp_path / "jobs" / gone)
    found = examine(data=tmp_path)["results"]
    assert not found["ok"]
    assert f"of 2 jobs 1 are gone ({gone})" in found["detail"]


def test_stores_that_answer_and_those_that_do_not_are_named(
    examine: Callable[..., dict], tmp_path: Path, network: Network, object_server: str
) -> None:
    assert examine(data=tmp_path)["stores"]["ok"]
    client_of(object_server, "examined")
    there = {"store_endpoint": network.url, "store_timeout_s": 5.0, "import_prefixes": ("s3://examined/in/",)}
    assert examine(data=tmp_path, **there)["stores"] == {"ok": True, "detail": "s3://examined/in/: answer"}
    found = examine(data=tmp_path, **there, deliver_prefixes=("s3://nobody/", f"file://{tmp_path}/nas/"))["stores"]
    assert not found["ok"]
    assert "NoSuchBucket" in found["detail"]
    assert "is it mounted?" in found["detail"]
    network.fail("503", 1000)
    assert "503" in examine(data=tmp_path, **there | {"store_timeout_s": 0.3})["stores"]["detail"]
