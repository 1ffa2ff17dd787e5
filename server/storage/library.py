"""Indexes captures and sessions in the database, so that one query returns a page of even a hundred thousand.

The records in the data folder are authoritative, and each write of a record also writes its row. ``Library.reconcile``,
called at each start, corrects rows that differ after a backup was restored, a record was removed by hand, or an earlier
version wrote the data folder.
"""

from collections.abc import Callable, Collection, Mapping, Sequence
from dataclasses import dataclass
from typing import Literal

import sqlalchemy as sa
import structlog
from sqlalchemy.exc import DataError

from server.storage.database import capture_index, capture_tags, insert_into, portions, scrub, session_index
from server.storage.pages import Order, Page, contains, folded, is_or_ends, page_of, storable, words_of
from server.storage.records import CaptureRecord, SessionRecord

UNJUDGED = "none"  # the verdict of captures that were not judged
CaptureOrder = Literal["-created", "created", "label", "-label", "verdict", "-bytes"]
SubjectOrder = Literal["-created", "created", "label", "-label"]

log = structlog.get_logger()
UNFIT = (DataError, OverflowError)  # of one row's values, not of the database
Record = CaptureRecord | SessionRecord
TABLES = {"captures": capture_index, "sessions": session_index}


@dataclass(frozen=True, slots=True)
class CaptureQuery:
    """Describes which captures are listed and in what order. Every word of ``sought`` must occur in the capture's
    label, expression, tags, session, verdict, source or id. ``before``: only captures older than this id. The other
    fields restrict the list if they are not None."""

    sought: str = ""
    session: str | None = None
    verdict: str | None = None
    board: bool | None = None
    before: str | None = None
    tag: str | None = None
    order: CaptureOrder = "-created"


class Library:
    """Reads and changes the index of captures and sessions. Methods block on the database."""

    def __init__(self, engine: sa.Engine) -> None:
        self._engine = engine

    def put(self, record: Record, changed: int) -> None:
        """Writes a capture, with its tags, or a session to the index, replacing earlier rows. ``changed``: time of the
        record's file (ns)."""
        table = capture_index if isinstance(record, CaptureRecord) else session_index
        self._put(table, [record], {record.id: changed})

    def drop(self, kind: str, identity: str) -> None:
        """Removes a capture, with its tags, or a session (``kind``: "captures", "sessions") from the index."""
        self._drop(TABLES[kind], [identity])

    def scrub(self) -> None:
        """Overwrites remains of deleted rows in the database's files, which may contain names of people."""
        scrub(self._engine)

    def captures(self, query: CaptureQuery, limit: int, cursor: str | None = None) -> Page[str]:
        """Returns one page of the captures that match a query. Raises InputError for a cursor of another list."""
        table = capture_index.c
        rows = sa.select().select_from(capture_index)
        if query.session is not None:
            rows = rows.where(table.session == query.session)
        if query.verdict is not None:
            rows = rows.where(table.verdict == query.verdict)
        if query.board is not None:
            rows = rows.where(table.board == query.board)
        if query.tag is not None:
            rows = rows.where(table.id.in_(tagged(query.tag)))
        if query.before is not None:
            rows = rows.where(table.id < query.before)
        for word in words_of(query.sought):
            rows = rows.where(captures_with(word))
        name = query.order.removeprefix("-")
        column = {"created": table.id, "label": sa.func.lower(table.label, type_=sa.Text())}.get(name)
        order = Order(table[name] if column is None else column, table.id, query.order.startswith("-"))
        with self._engine.connect() as connection:
            return page_of(connection, rows, order, limit, cursor, searched=bool(query.sought))

    def captures_of(self, sessions: Collection[str]) -> dict[str, list[str]]:
        """Returns the ids of the captures of each session, newest first."""
        found: dict[str, list[str]] = {session: [] for session in sessions}
        query = sa.select(capture_index.c.session, capture_index.c.id).order_by(capture_index.c.id.desc())
        with self._engine.connect() as connection:
            for some in portions(sessions):
                for row in connection.execute(query.where(capture_index.c.session.in_(some))):
                    found[row.session].append(row.id)
        return found

    def tags(self, limit: int) -> list[str]:
        """Returns the tags of all captures, the most frequent first, ``limit`` at most. Tags that differ in case only
        count as one."""
        table = capture_tags.c
        query = sa.select(sa.func.min(table.name, type_=sa.Text())).group_by(table.folded)
        with self._engine.connect() as connection:
            return [*connection.scalars(query.order_by(sa.func.count().desc(), table.folded).limit(limit))]

    def tags_of(self, captures: Collection[str]) -> dict[str, list[str]]:
        """Returns the tags of each of these captures; captures without tags are left out."""
        found: dict[str, list[str]] = {}
        query = sa.select(capture_tags.c.capture_id, capture_tags.c.name).order_by(capture_tags.c.folded)
        with self._engine.connect() as connection:
            for some in portions(captures):
                for row in connection.execute(query.where(capture_tags.c.capture_id.in_(some))):
                    found.setdefault(row.capture_id, []).append(row.name)
        return found

    def heads_of(self, session: str) -> list[str]:
        """Lists the ids of the captures of a session that are shots of a head, newest first."""
        table = capture_index.c
        query = sa.select(table.id).where(table.session == session, table.board.is_(False)).order_by(table.id.desc())
        with self._engine.connect() as connection:
            return [*connection.scalars(query)]

    def boards_among(self, captures: Collection[str]) -> dict[str, bool]:
        """Returns for each of the captures whether it is no shot of a head. Ids of no capture are left out."""
        table, found = capture_index.c, dict[str, bool]()
        with self._engine.connect() as connection:
            for some in portions(captures):
                rows = connection.execute(sa.select(table.id, table.board).where(table.id.in_(some)))
                found |= {row.id: row.board for row in rows}
        return found

    def heads_labelled(self, prefix: str) -> list[str]:
        """Lists the ids of the shots of a head whose label begins with ``prefix``, oldest first. Upper
        and lower case letters of a label count as the same."""
        table, begun = capture_index.c, folded(prefix)
        query = sa.select(table.id, table.label).where(
            table.board.is_(False), table.words.startswith(begun, autoescape=True)
        )
        with self._engine.connect() as connection:  # the words go on after the label
            rows = connection.execute(query.order_by(table.id)).all()
        return [row.id for row in rows if folded(row.label).startswith(begun)]

    def sessions_of(self, subject: str) -> list[str]:
        """Lists the ids of the sessions of one ``subject``, which is a value of ``subject_of``."""
        with self._engine.connect() as connection:
            return [*connection.scalars(sa.select(session_index.c.id).where(session_index.c.subject == subject))]

    def sessions(self, sought: str, limit: int, cursor: str | None = None) -> Page[str]:
        """Returns one page of the sessions in which all words of ``sought`` occur, newest first. Raises InputError for
        a cursor of another list."""
        rows = sa.select().select_from(session_index)
        for word in words_of(sought):
            rows = rows.where(sessions_with(word))
        with self._engine.connect() as connection:
            order = Order(session_index.c.id, session_index.c.id, descending=True)
            return page_of(connection, rows, order, limit, cursor)

    def subjects(
        self, sought: str, order: SubjectOrder, limit: int, cursor: str | None = None, tag: str | None = None
    ) -> Page[tuple[str, ...]]:
        """Returns one page of subjects, each as the ids of its sessions, newest first. Sessions with the same name are
        one subject; a session without a name is a subject of its own. A subject is as new as its newest session.

        ``tag``: only subjects with a capture that has this tag. Raises InputError for a cursor of another list.
        """
        table = session_index.c
        newest, name = (
            sa.func.max(table.id).label("newest"),
            sa.func.min(sa.func.lower(table.label), type_=sa.Text()).label("name"),
        )
        rows = sa.select(table.subject, newest, name).group_by(table.subject)
        for word in words_of(sought):
            rows = rows.where(sessions_with(word))
        if tag is not None:
            theirs = sa.select(capture_index.c.session).where(capture_index.c.id.in_(tagged(tag)))
            rows = rows.where(table.subject.in_(sa.select(table.subject).where(table.id.in_(theirs))))
        one = rows.subquery()
        by = one.c.newest if order.removeprefix("-") == "created" else one.c.name
        wanted = Order(by, one.c.newest, order.startswith("-"))
        with self._engine.connect() as connection:
            page = page_of(connection, sa.select().select_from(one), wanted, limit, cursor)
            theirs = sa.select(table.subject).where(table.id.in_(page.items))
            sessions = sa.select(table.id, table.subject).where(table.subject.in_(theirs)).order_by(table.id.desc())
            found: dict[str, list[str]] = {}
            for row in connection.execute(sessions):
                found.setdefault(row.subject, []).append(row.id)
        of = {identity: tuple(ids) for ids in found.values() for identity in ids}
        there = (of[identity] for identity in page.items if identity in of)  # the others were erased since the page
        return page.of(there)

    def reconcile(self, changes: Callable[[str], Mapping[str, int]], found: Callable[[str, str], Record | None]) -> int:
        """Makes the index agree with the records in the data folder. Returns how many rows differed. A record that does
        not fit a row is left out and logged. ``changes`` and ``found`` are methods of the ``Store``."""
        mended = 0
        for kind, table in TABLES.items():
            with self._engine.connect() as connection:
                known = {row.id: row.changed for row in connection.execute(sa.select(table.c.id, table.c.changed))}
            there = changes(kind)  # asked second: what is added in between is no stray row
            self._drop(table, gone := [identity for identity in known if identity not in there])
            differing = [identity for identity, changed in there.items() if known.get(identity) != changed]
            records = [record for identity in differing if (record := found(kind, identity)) is not None]
            mended += len(gone) + self._put_fitting(table, records, there)
        if mended:
            log.info("index mended", rows=mended)
        return mended

    def _put_fitting(self, table: sa.Table, records: Sequence[Record], changes: Mapping[str, int]) -> int:
        """Writes the rows of records and returns how many were written. A record whose values fit no column is left out
        and logged, so that it does not keep the service from starting."""
        try:
            self._put(table, records, changes)
        except UNFIT as error:
            if len(records) == 1:
                log.error("record left out of the index", table=table.name, id=records[0].id, error=str(error)[:300])
                return 0
            half = len(records) // 2
            return sum(self._put_fitting(table, some, changes) for some in (records[:half], records[half:]))
        return len(records)

    def _put(self, table: sa.Table, records: Sequence[Record], changes: Mapping[str, int]) -> None:
        rows = [_row_of(record, changes[record.id]) for record in records]
        with self._engine.begin() as connection:
            for some in portions(rows):
                statement = insert_into(self._engine, table)
                new = {column.name: statement.excluded[column.name] for column in table.c if not column.primary_key}
                connection.execute(statement.on_conflict_do_update(index_elements=["id"], set_=new), some)
        self._put_tags([record for record in records if isinstance(record, CaptureRecord)])

    def _put_tags(self, records: Collection[CaptureRecord]) -> None:
        names = {(record.id, folded(tag)): storable(tag) for record in records for tag in record.tags}
        rows = [{"capture_id": capture, "folded": tag, "name": name} for (capture, tag), name in names.items()]
        with self._engine.begin() as connection:
            for some in portions([record.id for record in records]):
                connection.execute(sa.delete(capture_tags).where(capture_tags.c.capture_id.in_(some)))
            for some in portions(rows):
                connection.execute(sa.insert(capture_tags), some)

    def _drop(self, table: sa.Table, ids: Collection[str]) -> None:
        with self._engine.begin() as connection:
            for some in portions(ids):
                connection.execute(sa.delete(table).where(table.c.id.in_(some)))
                if table is capture_index:
                    connection.execute(sa.delete(capture_tags).where(capture_tags.c.capture_id.in_(some)))


def captures_with(word: str) -> sa.ColumnElement[bool]:
    """Returns the SQL condition that a word of a search occurs in a capture or its session, or is its id or the id's
    end."""
    sessions = sa.select(session_index.c.id).where(sessions_with(word))
    matches = sa.or_(contains(capture_index.c.words, word), is_or_ends(capture_index.c.id, word))
    return sa.or_(matches, capture_index.c.session.in_(sessions))


def tagged(tag: str) -> sa.Select:
    """Returns the SQL query for the ids of all captures with a tag, whatever its case."""
    return sa.select(capture_tags.c.capture_id).where(capture_tags.c.folded == folded(tag))


def sessions_with(word: str) -> sa.ColumnElement[bool]:
    """Returns the SQL condition that a word of a search occurs in a session's label or consent note, or is its id or
    the id's end."""
    return sa.or_(contains(session_index.c.words, word), is_or_ends(session_index.c.id, word))


def subject_of(record: SessionRecord) -> str:
    """Returns the text by which sessions belong to one subject: the session's name, or its id if it has no name."""
    return folded(record.label).strip() or record.id


def _row_of(record: Record, changed: int) -> dict[str, object]:
    row: dict[str, object] = {"id": record.id, "label": storable(record.label), "changed": changed}
    if isinstance(record, SessionRecord):
        return row | {"subject": subject_of(record), "words": folded(record.label, record.consent)}
    words = folded(record.label, record.expression, record.verdict, record.source, *record.tags)
    return row | {
        "session": None if record.session is None else storable(record.session),
        "verdict": record.verdict or UNJUDGED,
        "source": record.source,
        "board": record.kind != "shot",
        "bytes": record.bytes,
        "words": words,
    }
