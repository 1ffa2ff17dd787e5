"""How many jobs failed, by kind, whatever retention has removed of them since: what alerts go by."""

import sqlalchemy as sa
from sqlalchemy.dialects import postgresql, sqlite

from server.storage.database import failures


def note_failure(engine: sa.Engine, kind: str) -> None:
    """Counts one failure of a kind."""
    insert = sqlite.insert if engine.dialect.name == "sqlite" else postgresql.insert
    first = insert(failures).values(kind=kind, count=1)
    with engine.begin() as connection:
        more = {"count": failures.c["count"] + 1}
        connection.execute(first.on_conflict_do_update(index_elements=["kind"], set_=more))


def failure_counts(engine: sa.Engine) -> dict[str, int]:
    """Returns the number of failures by kind."""
    with engine.connect() as connection:
        return {row[0]: row[1] for row in connection.execute(sa.select(failures.c.kind, failures.c["count"]))}
