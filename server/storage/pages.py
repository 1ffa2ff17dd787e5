"""Reads pages of a list: the query, a cursor that marks where a page ended, and the condition for rows that come after.

A list continues after the position of its last row (the sort value and, between equal values, the id), not after a
number of rows. Rows that are added or removed between two pages neither repeat nor drop others, and the last page is as
fast as the first.
"""

import base64
import json
from collections.abc import Iterable, Sequence
from dataclasses import dataclass
from typing import Generic, TypeVar

import sqlalchemy as sa

from rig.errors import InputError
from rig.messages.message import compose

WORDS_MOST = 10  # of a search: each is one comparison with every row
ID_LEAST = 6  # digits of an id's end that name it
Value = str | int | None
T = TypeVar("T")
V = TypeVar("V")


@dataclass(frozen=True, slots=True)
class Page(Generic[T]):
    """Holds one page of a list, in the list's order. ``next``: cursor of the next page, None on the last; ``total``:
    number of items on all pages."""

    items: tuple[T, ...]
    next: str | None
    total: int

    def of(self, items: Iterable[V]) -> "Page[V]":
        """Returns this page with other items."""
        return Page(tuple(items), self.next, self.total)


@dataclass(frozen=True, slots=True)
class Order:
    """Describes the order of a list: by ``column`` and, where that is equal, by ``identity``."""

    column: sa.ColumnElement[str] | sa.ColumnElement[int]
    identity: sa.ColumnElement[str]
    descending: bool

    def by(self) -> tuple[sa.ColumnElement, ...]:
        """Returns the columns of the order as SQL's ORDER BY needs them."""
        columns = dict.fromkeys((self.column, self.identity))
        return tuple(column.desc() if self.descending else column.asc() for column in columns)

    def after(self, cursor: str) -> sa.ColumnElement[bool]:
        """Returns the SQL condition for rows that come after a cursor. Raises InputError for a cursor of a list that is
        sorted by another type."""
        value, identity, _ = place_of(cursor)
        if isinstance(value, str) != isinstance(self.column.type, sa.String):
            raise no_cursor()
        if self.column is self.identity:
            return self.identity < identity if self.descending else self.identity > identity
        ended, row = (sa.tuple_(sa.literal(value), sa.literal(identity)), sa.tuple_(self.column, self.identity))
        return row < ended if self.descending else row > ended


def cursor_of(value: Value, identity: str, total: int) -> str:
    """Encodes where a page ended as a cursor: the value and the id of its last row, and how many rows the list had at
    its first page. Clients send the cursor back and need not understand it."""
    return base64.urlsafe_b64encode(json.dumps([value, identity, total]).encode()).decode().rstrip("=")


def place_of(cursor: str) -> tuple[str | int, str, int]:
    """Decodes a cursor to the values that ``cursor_of`` encoded. Raises InputError for a text that is not a cursor."""
    try:
        value, identity, total = json.loads(base64.urlsafe_b64decode(cursor + "=" * (-len(cursor) % 4)))
        text = f"{value}{identity}".encode()  # half of a surrogate pair is JSON and nothing that a database takes
    except (ValueError, RecursionError, TypeError) as error:
        raise no_cursor() from error
    if not (_is_whole(total) and total >= 0 and (isinstance(value, str) or _is_whole(value))):
        raise no_cursor()
    if not isinstance(identity, str) or b"\0" in text:
        raise no_cursor()
    return value, identity, total


def _is_whole(part: object) -> bool:
    return isinstance(part, int) and not isinstance(part, bool) and abs(part) < 2**62


def no_cursor() -> InputError:
    """Returns the error for a text that is not a cursor of this list."""
    return InputError("cursor", [compose("cursor-of-other-list")])


def page_of(
    connection: sa.Connection, rows: sa.Select, order: Order, limit: int, cursor: str | None, *, searched: bool = False
) -> Page[str]:
    """Returns one page of a list: the rows of the query ``rows`` in ``order``, after ``cursor``, ``limit`` at most.

    ``searched``: the query is slow, so the total is counted within it and not by a second one. Raises InputError for a
    cursor of another list.
    """
    wanted = rows.with_only_columns(order.identity.label("id"), order.column.label("value"))
    if cursor is not None:
        total, wanted = place_of(cursor)[2], wanted.where(order.after(cursor))
    elif searched:
        total, wanted = 0, wanted.add_columns(sa.func.count().over().label("total"))
    else:
        total = connection.scalar(rows.with_only_columns(sa.func.count())) or 0
    found = connection.execute(wanted.order_by(*order.by()).limit(limit + 1)).all()
    if cursor is None and searched and found:
        total = found[0].total
    more = len(found) > limit
    ids = tuple(row.id for row in found[:limit])
    return Page(ids, cursor_of(found[limit - 1].value, ids[-1], total) if more else None, total)


def words_of(sought: str) -> Sequence[str]:
    """Splits a search into its words, ``WORDS_MOST`` at most, all of which a found row must contain."""
    return folded(sought).split()[:WORDS_MOST]


def folded(*texts: str | None) -> str:
    """Joins texts to the form that searches compare: lower case, without NUL."""
    return storable(" ".join(text for text in texts if text)).casefold()


def storable(text: str) -> str:
    """Removes NUL from a text, which PostgreSQL cannot store; records of earlier versions may have it."""
    return text.replace("\0", "")


def contains(column: sa.ColumnElement[str], word: str) -> sa.ColumnElement[bool]:
    """Returns the SQL condition that a column contains a word."""
    return column.contains(word, autoescape=True)


def is_or_ends(identity: sa.ColumnElement[str], word: str) -> sa.ColumnElement[bool]:
    """Returns the SQL condition that an id is ``word`` or ends with it, since pages show only the ends of ids. A word
    of fewer than ``ID_LEAST`` characters never matches, as it would match too many ids."""
    return identity.endswith(word, autoescape=True) if len(word) >= ID_LEAST else sa.false()
