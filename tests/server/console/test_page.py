"""The values that open pages share."""

import time

import pytest

from server.console import page
from server.console.page import Cache


def test_a_value_that_took_long_once_is_not_kept_for_long(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(page, "KEEP_MOST_S", 0.1)
    cache = Cache()

    def slowly() -> str:
        time.sleep(0.2)  # as before a database that somebody holds: 9 times that would be 1.8 s
        return "old"

    assert cache.get("jobs", 0.0, slowly) == "old"
    assert cache.get("jobs", 0.0, lambda: "new") == "old", "what takes long is not made at every look"
    time.sleep(0.1)
    assert cache.get("jobs", 0.0, lambda: "new") == "new"


def test_what_changed_while_it_was_looked_at_is_looked_at_again() -> None:
    cache, jobs = Cache(), ["first"]

    def look() -> list[str]:
        seen = [*jobs]
        jobs.append("second")
        cache.forget("jobs")
        return seen

    assert cache.get("jobs", 60.0, look) == ["first"]
    assert cache.get("jobs", 60.0, jobs.copy) == ["first", "second"]
    jobs.append("third")
    assert cache.get("jobs", 60.0, jobs.copy) == ["first", "second"], "it is kept where nothing is forgotten"
