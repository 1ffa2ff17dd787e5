"""Defines the service's own tables, which lie beside the job engine's in one database (an SQLite file or PostgreSQL).

Times of workers, keys and events are seconds since 1970 on the *database's* clock. On one clock, hosts whose own clocks
differ agree on which worker has stopped its heartbeat.
"""

import os
import secrets
import sqlite3
import time
from collections.abc import Iterable, Iterator
from contextlib import suppress
from pathlib import Path
from typing import Any, TypeVar

import sqlalchemy as sa
from sqlalchemy import event
from sqlalchemy.dialects import postgresql, sqlite
from sqlalchemy.exc import IntegrityError, InterfaceError, InternalError, OperationalError, SQLAlchemyError
from sqlalchemy.exc import TimeoutError as PoolTimeout
from sqlalchemy.schema import CreateIndex, CreateTable

from rig.errors import EigenheadError
from rig.messages.message import compose
from server.settings import ServiceSettings

CONNECT_S = 10  # a database that does not even refuse
ENGINE_TABLES = ("workflow_status", "workflow_input", "workflow_output", "operation_outputs")
SCRUB_TRIES, SCRUB_PAUSE_S = 20, 0.05
AWAY = (OperationalError, InterfaceError, InternalError, PoolTimeout)
"""What is raised where the database does not answer. InternalError: PostgreSQL ended a transaction that was silent for
longer than it may be, as over a link that was cut."""

AT_ONCE = 500  # rows in one statement: databases bound how many values one may have

metadata = sa.MetaData()
T = TypeVar("T")


def portions(values: Iterable[T]) -> Iterator[list[T]]:
    """Yields the values in lists of at most ``AT_ONCE``."""
    listed = list(values)
    return (listed[start : start + AT_ONCE] for start in range(0, len(listed), AT_ONCE))


class DatabaseUnavailable(EigenheadError):
    """Reports that the database does not answer, or is damaged."""

    def __init__(self, place: str, error: Exception) -> None:
        why = str(getattr(error, "orig", None) or error).strip().splitlines()[0]
        code = "database-away" if "://" in place else "database-damaged"  # without: SQLite in the data folder
        super().__init__(compose(code, place=place, why=why))


events = sa.Table(
    "eigenhead_events",
    metadata,
    sa.Column("job_id", sa.String(64), primary_key=True),
    sa.Column("seq", sa.Integer, primary_key=True, autoincrement=False),
    sa.Column("at", sa.Float, nullable=False),
    sa.Column("document", sa.Text, nullable=False),
)

job_index = sa.Table(  # what jobs are looked up by; the job itself is the engine's row
    "eigenhead_job_index",
    metadata,
    sa.Column("job_id", sa.String(64), primary_key=True),
    sa.Column("capture_id", sa.String(64), nullable=False, index=True),
    sa.Column("session", sa.String(64), nullable=True, index=True),
    sa.Column("words", sa.Text, nullable=True),  # what a search compares; None in rows of earlier versions
)

capture_index = sa.Table(  # what captures are found by; the capture itself is its record in the data folder
    "eigenhead_capture_index",
    metadata,
    sa.Column("id", sa.String(64), primary_key=True),
    sa.Column("session", sa.String(64), nullable=True, index=True),
    sa.Column("label", sa.Text, nullable=False),
    sa.Column("verdict", sa.String(16), nullable=False),
    sa.Column("source", sa.String(16), nullable=False),
    sa.Column("board", sa.Boolean, nullable=False),  # or a film: no shot of a head
    sa.Column("bytes", sa.BigInteger, nullable=False),
    sa.Column("words", sa.Text, nullable=False),
    sa.Column("changed", sa.BigInteger, nullable=False),  # of its record, in ns: tells whether the row is of it still
)

capture_tags = sa.Table(  # of the captures' records, too
    "eigenhead_capture_tags",
    metadata,
    sa.Column("capture_id", sa.String(64), primary_key=True),
    sa.Column("folded", sa.String(200), primary_key=True, index=True),  # without case
    sa.Column("name", sa.Text, nullable=False),
)

blobs = sa.Table(  # contents in the store of captures
    "eigenhead_blobs",
    metadata,
    sa.Column("id", sa.String(96), primary_key=True),
    sa.Column("sha256", sa.String(64), nullable=False, index=True),
    sa.Column("bytes", sa.BigInteger, nullable=False),
    sa.Column("stored", sa.Boolean, nullable=False),
    sa.Column("dead", sa.Boolean, nullable=False),  # nothing refers to it, or will
)

capture_files = sa.Table(
    "eigenhead_capture_files",
    metadata,
    sa.Column("capture_id", sa.String(64), primary_key=True),
    sa.Column("name", sa.Text, primary_key=True),
    sa.Column("blob_id", sa.String(96), nullable=False, index=True),
    sa.Column("arrived", sa.Boolean, nullable=False),  # all files of the capture are in the store
)

session_index = sa.Table(
    "eigenhead_session_index",
    metadata,
    sa.Column("id", sa.String(64), primary_key=True),
    sa.Column("subject", sa.Text, nullable=False, index=True),  # what sessions of one person have alike
    sa.Column("label", sa.Text, nullable=False),
    sa.Column("words", sa.Text, nullable=False),
    sa.Column("changed", sa.BigInteger, nullable=False),
)

batches = sa.Table(
    "eigenhead_batches",
    metadata,
    sa.Column("id", sa.String(64), primary_key=True),
    sa.Column("created", sa.BigInteger, nullable=False),  # ms since 1970
    sa.Column("label", sa.Text, nullable=False),
    sa.Column("words", sa.Text, nullable=False),  # what a search compares
    sa.Column("key", sa.String(64), nullable=False, index=True),
    sa.Column("digest", sa.String(64), nullable=False),  # of the request, for a key that repeats it
    sa.Column("wish", sa.String(16), nullable=False),  # what its owner wants: running, paused, cancelled
    sa.Column("finished", sa.BigInteger, nullable=True, index=True),  # ms; NULL while something is to be done
    sa.Column("rounds", sa.Integer, nullable=False),  # how often it finished
    sa.Column("queue", sa.String(64), nullable=False),
    sa.Column("priority", sa.Integer, nullable=False),
    sa.Column("model", sa.Text, nullable=True),
    sa.Column("settings", sa.Text, nullable=False),  # JSON
    sa.Column("deliver_to", sa.Text, nullable=True),
)

batch_items = sa.Table(  # a capture of a batch; its job, once it has one, is the engine's row
    "eigenhead_batch_items",
    metadata,
    sa.Column("batch_id", sa.String(64), primary_key=True),
    sa.Column("position", sa.Integer, primary_key=True, autoincrement=False),
    sa.Column("capture_id", sa.String(64), nullable=True, index=True),  # NULL: erased
    sa.Column("job_id", sa.String(64), nullable=True, index=True),  # NULL: waits
    sa.Column("recalled", sa.Boolean, nullable=False, default=False),  # its job is being taken back
    sa.Index("eigenhead_batch_items_waiting", "batch_id", "job_id"),
)
sa.Index(
    "eigenhead_batch_items_recalled",
    batch_items.c.batch_id,
    sqlite_where=batch_items.c.recalled.is_(sa.true()),
    postgresql_where=batch_items.c.recalled.is_(sa.true()),
)

failures = sa.Table(  # how many jobs failed, by kind, since the database was made
    "eigenhead_failures",
    metadata,
    sa.Column("kind", sa.String(64), primary_key=True),
    sa.Column("count", sa.BigInteger, nullable=False),
)

workers = sa.Table(
    "eigenhead_workers",
    metadata,
    sa.Column("id", sa.String(64), primary_key=True),
    sa.Column("machine", sa.String(200), nullable=False),  # boot and process namespace: where the pid means something
    sa.Column("host", sa.String(200), nullable=False),
    sa.Column("pid", sa.Integer, nullable=False),
    sa.Column("pid_started", sa.BigInteger, nullable=False),  # a pid is used again; with its start time it is unique
    sa.Column("queue", sa.String(64), nullable=False),
    sa.Column("concurrency", sa.Integer, nullable=False),
    sa.Column("version", sa.String(64), nullable=False),
    sa.Column("started", sa.Float, nullable=False),
    sa.Column("seen", sa.Float, nullable=False),
    sa.Column("stopped", sa.Float, nullable=True),
)

api_keys = sa.Table(
    "eigenhead_api_keys",
    metadata,
    sa.Column("id", sa.String(32), primary_key=True),
    sa.Column("name", sa.String(200), nullable=False),
    sa.Column("digest", sa.String(64), nullable=False),
    sa.Column("scopes", sa.String(200), nullable=False),
    sa.Column("created", sa.Float, nullable=False),
)

webhooks = sa.Table(
    "eigenhead_webhooks",
    metadata,
    sa.Column("id", sa.String(32), primary_key=True),
    sa.Column("url", sa.Text, nullable=False),
    sa.Column("secret", sa.String(200), nullable=False),
    sa.Column("created", sa.Float, nullable=False),
)

identities = sa.Table(  # one row: what a store of results knows the database by
    "eigenhead_identity",
    metadata,
    sa.Column("row", sa.Integer, primary_key=True, autoincrement=False),
    sa.Column("name", sa.String(64), nullable=False),
)


@event.listens_for(sa.Engine, "connect")
def _delete_securely(connection: Any, record: Any) -> None:
    """Makes SQLite overwrite deleted rows, also for the job engine's own connections."""
    if isinstance(connection, sqlite3.Connection):
        connection.execute("PRAGMA secure_delete=ON")


def open_database(settings: ServiceSettings) -> sa.Engine:
    """Opens the service's database, creates missing tables and columns, and returns the engine. Raises
    DatabaseUnavailable."""
    url = sa.make_url(settings.url)
    if url.get_backend_name() == "sqlite":
        file = Path(str(url.database))
        file.parent.mkdir(parents=True, exist_ok=True)
        if os.geteuid() == 0 and not file.exists():  # root makes the first key; the service must write here, too
            file.touch(0o600)
            os.chown(file, file.parent.stat().st_uid, file.parent.stat().st_gid)
        engine = sa.create_engine(url, connect_args={"timeout": 30}, pool_size=10, max_overflow=10)

        @event.listens_for(engine, "connect")
        def prepare(connection: Any, record: Any) -> None:
            connection.isolation_level = "IMMEDIATE"  # a writer that starts as a reader could not wait for its turn
            connection.execute("PRAGMA busy_timeout=30000")
            with suppress(sqlite3.OperationalError):  # locked: another process is just setting it
                connection.execute("PRAGMA journal_mode=WAL")  # kept in the file: the job engine's connections read it
            connection.execute("PRAGMA synchronous=FULL")  # WAL's default loses the last commits with the power
    else:
        patience = {"connect_timeout": CONNECT_S}
        engine = sa.create_engine(url, pool_pre_ping=True, pool_size=5, max_overflow=10, connect_args=patience)
    try:
        with engine.begin() as connection:
            for table in metadata.sorted_tables:  # in one statement each: a worker may create them at the same moment
                connection.execute(CreateTable(table, if_not_exists=True))
        _add_columns(engine)
        with engine.begin() as connection:
            for index in (index for table in metadata.sorted_tables for index in table.indexes):
                connection.execute(CreateIndex(index, if_not_exists=True))
    except (SQLAlchemyError, sqlite3.Error) as error:
        raise DatabaseUnavailable(settings.place, error) from error
    return engine


def check_pages(engine: sa.Engine, place: str) -> None:
    """Raises DatabaseUnavailable for an SQLite file whose pages are damaged, the job engine's tables included."""
    if engine.dialect.name == "sqlite":
        try:
            with engine.connect() as connection:
                said = connection.scalar(sa.text("PRAGMA quick_check(1)"))
        except SQLAlchemyError as error:
            raise DatabaseUnavailable(place, error) from error
        if said != "ok":
            raise DatabaseUnavailable(place, ValueError(said))


def _add_columns(engine: sa.Engine) -> None:
    """Adds missing columns to tables of an earlier version; all of these columns may be empty."""
    for table, name in ((job_index, "words"), (batches, "deliver_to")):
        if name not in {column["name"] for column in sa.inspect(engine).get_columns(table.name)}:
            with engine.begin() as connection:
                connection.execute(sa.text(f"ALTER TABLE {table.name} ADD COLUMN {name} TEXT"))


def database_identity(engine: sa.Engine) -> str:
    """Returns the permanent name that a database gave itself."""
    with suppress(IntegrityError), engine.begin() as connection:  # another process was first
        if connection.scalar(sa.select(identities.c.name)) is None:
            connection.execute(sa.insert(identities).values(row=1, name=secrets.token_hex(16)))
    with engine.connect() as connection:
        return connection.scalars(sa.select(identities.c.name)).one()


def scrub(engine: sa.Engine) -> None:
    """Overwrites remains of deleted rows in the database's files, which may contain names of people. Pages that another
    connection is reading are overwritten at the next call."""
    if engine.dialect.name != "sqlite":
        tables = ", ".join(table.name for table in (capture_index, capture_tags, session_index, job_index, batches))
        tables += "".join(f", dbos.{name}" for name in ENGINE_TABLES)
        with engine.connect().execution_options(isolation_level="AUTOCOMMIT") as connection:
            connection.execute(sa.text(f"VACUUM {tables}"))
        return
    with (
        engine.connect() as connection
    ):  # the driver begins no transaction before a pragma; AUTOCOMMIT would outlast it
        for _ in range(SCRUB_TRIES):
            busy, _, _ = connection.execute(sa.text("PRAGMA wal_checkpoint(TRUNCATE)")).one()
            if not busy:
                return
            time.sleep(SCRUB_PAUSE_S)


def alive_workers(connection: sa.Connection, silent_s: float) -> sa.ColumnElement[bool]:
    """Returns the SQL condition that a worker has not stopped and has sent a heartbeat within the last ``silent_s``
    seconds."""
    return sa.and_(workers.c.stopped.is_(None), workers.c.seen > now_sql(connection) - silent_s)


def slots_by_queue(engine: sa.Engine, silent_s: float) -> dict[str, int]:
    """Returns how many jobs the live workers of each queue run at once."""
    slots = sa.select(workers.c.queue, sa.func.sum(workers.c.concurrency)).group_by(workers.c.queue)
    with engine.connect() as connection:
        return {row[0]: row[1] for row in connection.execute(slots.where(alive_workers(connection, silent_s)))}


def now_sql(engine: sa.Engine | sa.Connection) -> sa.ColumnElement[float]:
    """Returns the SQL expression for the seconds since 1970 on the database's clock."""
    if engine.dialect.name == "sqlite":
        return sa.literal_column("((julianday('now') - 2440587.5) * 86400.0)", sa.Float)
    return sa.literal_column("extract(epoch from clock_timestamp())", sa.Float)


def insert_into(engine: sa.Engine | sa.Connection, table: sa.Table) -> "sqlite.Insert | postgresql.Insert":
    """Returns an SQL insertion that can state what happens on a conflict."""
    return sqlite.insert(table) if engine.dialect.name == "sqlite" else postgresql.insert(table)
