"""Pages of a list: what is asked for, a cursor that goes on where a page ended, and the condition for what comes after.

Lists go on after a *place* (the value they are sorted by, and an id where values are equal), not after a number of
rows: what is added or removed meanwhile neither repeats nor drops a line, and the last page costs what the first does.
"""

import base64
import json
from collections.abc import Sequence
from dataclasses import dataclass

import sqlalchemy as sa

from rig.errors import InputError

WORDS_MOST = 10  # of a search: each is one comparison with every row
Value = str | int | None


@dataclass(frozen=True, slots=True)
class PageOf:
    """Ids of one page, in their order; ``next`` is the cursor of the page after it, None on the last; ``total`` counts
    what all pages hold."""

    ids: tuple[str, ...]
    next: str | None
    total: int


@dataclass(frozen=True, slots=True)
class Order:
    """Rows sorted by ``column`` and, where that is equal, by ``identity``."""

    column: sa.ColumnElement[str] | sa.ColumnElement[int]
    identity: sa.ColumnElement[str]
    descending: bool

    def by(self) -> tuple[sa.ColumnElement, ...]:
        columns = dict.fromkeys((self.column, self.identity))
        return tuple(column.desc() if self.descending else column.asc() for column in columns)

    def after(self, cursor: str) -> sa.ColumnElement[bool]:
        """Of the rows that come after a cursor. Raises InputError for what is no cursor of such a list."""
        value, identity = place_of(cursor)
        if isinstance(value, str) != isinstance(self.column.type, sa.String):
            raise no_cursor()
        if self.column is self.identity:
            return self.identity < identity if self.descending else self.identity > identity
        place, row = sa.tuple_(sa.literal(value), sa.literal(identity)), sa.tuple_(self.column, self.identity)
        return row < place if self.descending else row > place


def cursor_of(value: Value, identity: str) -> str:
    return base64.urlsafe_b64encode(json.dumps([value, identity]).encode()).decode().rstrip("=")


def place_of(cursor: str) -> tuple[str | int, str]:
    """What a cursor names. Raises InputError."""
    try:
        value, identity = json.loads(base64.urlsafe_b64decode(cursor + "=" * (-len(cursor) % 4)))
    except (ValueError, RecursionError, TypeError) as error:
        raise no_cursor() from error
    whole = isinstance(value, int) and not isinstance(value, bool) and abs(value) < 2**62
    if not (isinstance(value, str) or whole) or not isinstance(identity, str) or "\0" in f"{value}{identity}":
        raise no_cursor()
    return value, identity


def no_cursor() -> InputError:
    return InputError("cursor", ["is not what 'next' of this list in this order said: begin without one"])


def page_of(
    connection: sa.Connection, rows: sa.Select, order: Order, limit: int, cursor: str | None, total: int | None = None
) -> PageOf:
    """One page of ``rows``, which select nothing yet; ``total`` where it is known. Raises InputError."""
    if total is None:
        total = connection.scalar(rows.with_only_columns(sa.func.count())) or 0
    wanted = rows.with_only_columns(order.identity.label("id"), order.column.label("value"))
    if cursor is not None:
        wanted = wanted.where(order.after(cursor))
    found = connection.execute(wanted.order_by(*order.by()).limit(limit + 1)).all()
    more = len(found) > limit
    ids = tuple(row.id for row in found[:limit])
    return PageOf(ids, cursor_of(found[limit - 1].value, ids[-1]) if more else None, total)


def words_of(sought: str) -> Sequence[str]:
    """The words of a search, which must all be found."""
    return folded(sought).replace("\0", "").split()[:WORDS_MOST]


def folded(*texts: str | None) -> str:
    """What searches compare: without case."""
    return " ".join(text for text in texts if text).casefold()


def contains(column: sa.ColumnElement[str], word: str) -> sa.ColumnElement[bool]:
    return column.contains(word, autoescape=True)
