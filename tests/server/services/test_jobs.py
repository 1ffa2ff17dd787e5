"""Jobs as the service lists them: what a page asks of the database."""

from collections.abc import Iterator
from pathlib import Path

import pytest
import sqlalchemy as sa
from sqlalchemy import event

from server.services.jobs import Jobs, migrate
from server.services.work import ReconstructionRequest
from server.settings import ServiceSettings
from server.storage.database import open_database
from server.storage.job_index import JobQuery
from server.storage.library import Library
from server.storage.store import Store
from tests.support.services import small_capture
from tests.support.stored_captures import stored_files


@pytest.fixture
def engine(tmp_path: Path) -> Iterator[sa.Engine]:
    engine = open_database(ServiceSettings(data=tmp_path / "data"))
    yield engine
    engine.dispose()


@pytest.fixture
def jobs(engine: sa.Engine, tmp_path: Path) -> Iterator[Jobs]:
    settings, library = ServiceSettings(data=tmp_path / "data"), Library(engine)
    migrate(settings)
    jobs = Jobs(settings, Store(settings.data, library), engine, library)
    yield jobs
    jobs.close()


@pytest.fixture
def capture(jobs: Jobs, tmp_path: Path) -> str:
    return stored_files(jobs._store, small_capture(tmp_path / "capture"))


def test_a_page_of_queued_jobs_asks_no_more_for_many_than_for_few(jobs: Jobs, engine: sa.Engine, capture: str) -> None:
    statements = list[str]()
    event.listen(engine, "before_cursor_execute", lambda *arguments: statements.append(arguments[2]))

    def count_of(limit: int) -> int:
        statements.clear()
        page = jobs.page(JobQuery(), limit)
        assert len(page.items) == limit
        assert all(job.notice is not None and job.notice.code == "worker-starting" for job in page.items)
        return len(statements)

    for _ in range(12):
        jobs.submit(capture, ReconstructionRequest())
    assert count_of(12) == count_of(2)
