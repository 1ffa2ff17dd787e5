"""Errors as answers: whose fault it is, and text that can be sent whatever it quotes."""

import json

import pytest
from sqlalchemy.exc import DataError, OperationalError

from rig.errors import InputError
from server.wire.problems import problem_from


@pytest.mark.parametrize(
    ("error", "status"),
    [
        (DataError("SELECT", {}, ValueError("PostgreSQL text fields cannot contain NUL (0x00) bytes")), 422),
        (OperationalError("SELECT", {}, OSError("gone")), 503),
    ],
)
def test_a_value_that_the_database_cannot_keep_is_the_callers_fault(error: Exception, status: int) -> None:
    assert problem_from(error).status == status


def test_an_answer_quotes_what_is_no_text() -> None:
    document = json.loads(bytes(problem_from(InputError("settings", ["unknown key \ud800"])).response().body))
    assert document["errors"] == ["unknown key \\ud800"]
