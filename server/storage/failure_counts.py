"""Counts failed jobs by kind for the metrics. The counts stay when retention removes the jobs, so that alerts can use
them."""

import sqlalchemy as sa
from sqlalchemy.dialects import postgresql, sqlite

from server.storage.database import failures


def note_failure(connection: sa.Connection, kind: str) -> None:
    """Adds one to the count of a kind of failure in the caller's transaction."""
    insert = sqlite.insert if connection.dialect.name == "sqlite" else postgresql.insert
    first = insert(failures).values(kind=kind, count=1)
    more = {"count": failures.c["count"] + 1}
    connection.execute(first.on_conflict_do_update(index_elements=["kind"], set_=more))


def failure_counts(engine: sa.Engine) -> dict[str, int]:
    """Returns the number of failures by kind."""
    with engine.connect() as connection:
        return {row[0]: row[1] for row in connection.execute(sa.select(failures.c.kind, failures.c["count"]))}
