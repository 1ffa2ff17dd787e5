"""The index of captures and sessions: pages that neither repeat nor drop, searches, people, what each start mends."""

import json
import shutil
from dataclasses import replace
from pathlib import Path
from typing import Any

import pytest
import sqlalchemy as sa

from rig.errors import InputError
from server.settings import ServiceSettings
from server.storage.database import capture_index, open_database
from server.storage.library import CaptureQuery, Library, subject_of
from server.storage.pages import Page, page_of
from server.storage.records import CAPTURE, CaptureRecord, SessionRecord
from server.storage.store import Store
from tests.support.stored_captures import capture_record, stored


def identity(number: int) -> str:
    return f"{number:028x}"


@pytest.fixture
def library(tmp_path: Path) -> Library:
    return Library(open_database(ServiceSettings(data=tmp_path)))


@pytest.fixture
def store(tmp_path: Path, library: Library) -> Store:
    return Store(tmp_path, library)


def capture(number: int, **fields: object) -> CaptureRecord:
    return capture_record(id=identity(number), **fields)


def session(number: int, label: str) -> SessionRecord:
    return SessionRecord(identity(number), "2026-01-01T00:00:00.000Z", label, "signed")


def walked(library: Library, query: CaptureQuery, limit: int) -> list[str]:
    found, cursor = [], None
    while True:
        page = library.captures(query, limit, cursor)
        found += page.items
        if (cursor := page.next) is None:
            return found


def test_pages_go_on_where_they_ended_whatever_comes_and_goes(store: Store, library: Library) -> None:
    for number in range(1, 8):
        stored(store, capture(number))
    first = library.captures(CaptureQuery(), 3)
    assert (first.items, first.total) == ((identity(7), identity(6), identity(5)), 7)
    stored(store, capture(9))  # a newer one, and one of the first page goes
    store.remove_capture(identity(6))
    second = library.captures(CaptureQuery(), 3, first.next)
    assert second.items == (identity(4), identity(3), identity(2))
    assert library.captures(CaptureQuery(), 3, second.next).next is None


@pytest.mark.parametrize("order", ["-created", "created", "label", "-label", "verdict", "-bytes"])
def test_every_order_shows_each_capture_once_if_values_are_equal(store: Store, library: Library, order: str) -> None:
    for number in range(1, 12):
        record = capture(
            number, label="aBcA"[number % 3], bytes=number // 4, verdict=("good", "poor", None)[number % 3]
        )
        stored(store, record)
    query = CaptureQuery(order=order)  # type: ignore[arg-type]
    found = walked(library, query, 4)
    assert sorted(found) == [identity(number) for number in range(1, 12)]
    assert found == list(library.captures(query, 100).items)
    if order == "label":
        labels = [store.capture(one).label.casefold() for one in found]
        assert labels == sorted(labels)


def test_words_are_found_in_the_capture_and_in_its_session(store: Store, library: Library) -> None:
    store.add_session(session(1, "Änne Müller"))
    stored(store, capture(2, label="Profile 100%_left", session=identity(1), verdict="poor"))
    stored(store, capture(3, label="front", board=True))

    def found(sought: str, **more: object) -> tuple[str, ...]:
        return library.captures(replace(CaptureQuery(sought), **more), 10).items

    assert found("müller") == found("POOR änne") == found("100%_l") == (identity(2),)
    assert found("2") == ()  # a digit stands in too many ids
    assert found(identity(2)) == found(identity(2)[-6:]) == (identity(2),)
    assert found("nobody") == found("front poor") == ()
    assert found("", session=identity(1)) == found("", verdict="poor") == found("", board=False) == (identity(2),)
    assert found("", verdict="none") == found("", before=identity(3))[:0] + (identity(3),)
    store.add_session(session(1, "Berta"))
    assert found("müller") == ()
    assert found("berta") == (identity(2),)


@pytest.mark.parametrize(
    "cursor",
    [
        *("", "!", "bnVsbA", "WzEsMl0", "W251bGwsICJhIiwgMV0", "WyJhIiwgIlx1MDAwMCIsIDFd"),
        *("WyIyMDI2IiwiXHVkODAwIiwxXQ", "WyJcdWQ4MDAiLCIyMDI2IiwxXQ"),  # half of a surrogate pair
    ],
)
def test_a_cursor_of_nothing_is_refused_by_name(library: Library, cursor: str) -> None:
    with pytest.raises(InputError) as error:
        library.captures(CaptureQuery(), 3, cursor)
    assert "is no value of 'next' for this list" in str(error.value)


def test_a_cursor_of_another_order_is_refused(store: Store, library: Library) -> None:
    for number in range(1, 5):
        stored(store, capture(number))
    cursor = library.captures(CaptureQuery(order="-bytes"), 2).next
    with pytest.raises(InputError):
        library.captures(CaptureQuery(order="label"), 2, cursor)


def test_sessions_of_one_name_are_one_person(store: Store, library: Library) -> None:
    for number, label in ((1, "Anna"), (2, "bert"), (3, "anna "), (4, ""), (5, "")):
        store.add_session(session(number, label))
    page = library.subjects("", "-created", 10)
    assert page.items == ((identity(5),), (identity(4),), (identity(3), identity(1)), (identity(2),))
    assert page.total == 4
    by_name = library.subjects("", "label", 2)
    assert by_name.items == ((identity(4),), (identity(5),))
    assert library.subjects("", "label", 2, by_name.next).items == ((identity(3), identity(1)), (identity(2),))
    assert library.subjects("anna", "-created", 10).items == ((identity(3), identity(1)),)
    assert library.sessions_of(subject_of(session(1, "ANNA"))) == [identity(1), identity(3)]
    store.remove_session(identity(3))
    assert library.subjects("anna", "-created", 10).items == ((identity(1),),)


def test_each_start_mends_what_differs_from_the_records(tmp_path: Path, library: Library) -> None:
    bare = Store(tmp_path)  # of a version without an index
    for number in (1, 2, 3):
        stored(bare, capture(number, label=f"old {number}", tags=(f"tag {number}", "all")))
    bare.add_session(session(4, "Anna"))
    assert library.captures(CaptureQuery(), 10).items == ()
    assert library.reconcile(bare.changes, bare.found) == 4
    assert library.reconcile(bare.changes, bare.found) == 0
    assert library.tags(2) == ["all", "tag 1"]
    assert library.captures(CaptureQuery(tag="Tag 2"), 10).items == (identity(2),)
    shutil.rmtree(bare.folder("captures", identity(1)))  # by somebody else
    path = bare.folder("captures", identity(2)) / "record.json"  # from a backup
    path.write_text(json.dumps(CAPTURE.document(capture(2, label="restored"))))
    (bare.folder("captures", identity(3)) / "record.json").write_text("{")
    assert library.reconcile(bare.changes, bare.found) == 2
    assert library.tags(9) == ["all", "tag 3"], "the damaged one goes when it was found damaged"
    assert library.captures(CaptureQuery("restored"), 10).items == (identity(2),)
    library.reconcile(bare.changes, bare.found)
    assert library.captures(CaptureQuery(), 10).items == (identity(2),)  # the damaged one was set aside
    assert library.tags(9) == []


def test_a_record_that_no_column_takes_does_not_keep_the_service_from_starting(store: Store, library: Library) -> None:
    bare = Store(store.data)
    for number in range(1, 6):
        stored(bare, capture(number, bytes=1 << 70 if number == 3 else 1, label="Anna\0", tags=("a\0b",)))
    bare.add_session(SessionRecord(identity(9), "2026-01-01T00:00:00.000Z", "Anna\0", ""))
    assert library.reconcile(store.changes, store.found) == 5
    assert library.captures(CaptureQuery("anna", tag="ab"), 10).items == tuple(identity(n) for n in (5, 4, 2, 1))
    assert library.subjects("anna", "-created", 10).items == ((identity(9),),)
    with library._engine.connect() as connection:
        stored_texts = [*connection.scalars(sa.select(capture_index.c.label)), *library.tags(10)]
    assert not any("\0" in text for text in stored_texts)


def test_a_page_of_people_skips_who_was_erased(store: Store, library: Library, monkeypatch: pytest.MonkeyPatch) -> None:
    for number in (1, 2):
        store.add_session(session(number, f"Anna {number}"))

    def page_then_erasure(*arguments: Any, **named: Any) -> Page:
        page = page_of(*arguments, **named)
        store.remove_session(identity(1))
        return page

    monkeypatch.setattr("server.storage.library.page_of", page_then_erasure)
    assert library.subjects("", "-created", 10).items == ((identity(2),),)
