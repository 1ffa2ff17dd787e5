"""Errors as answers: whose fault it is, and text that can be sent whatever it quotes."""

import ast
import errno
import importlib
import json
from pathlib import Path

import pytest
from sqlalchemy.exc import DataError, OperationalError

from rig.errors import EigenheadError, InputError
from rig.messages.message import texts_of
from server.errors import Refused
from server.services.failures import JobFailed
from server.wire.problems import STATUS_OF, Problem, problem_from

ROOT = Path(__file__).resolve().parents[3]


@pytest.mark.parametrize(
    ("error", "status"),
    [
        (DataError("SELECT", {}, ValueError("PostgreSQL text fields cannot contain NUL (0x00) bytes")), 422),
        (OperationalError("SELECT", {}, OSError("gone")), 503),
    ],
)
def test_a_value_that_the_database_cannot_keep_is_the_callers_fault(error: Exception, status: int) -> None:
    assert problem_from(error).status == status


def test_a_data_folder_that_cannot_be_written_is_told() -> None:
    problem = problem_from(OSError(errno.EROFS, "Read-only file system", "/srv/heads/incoming/1"))
    assert (problem.status, problem.kind) == (503, "data-unwritable")
    assert "/srv" not in json.dumps(problem.document())


def test_an_answer_quotes_what_is_no_text() -> None:
    document = json.loads(bytes(problem_from(InputError("settings", ["unknown key \ud800"])).response().body))
    assert document["errors"] == ["unknown key \\ud800"]


def error_classes() -> list[type[EigenheadError]]:
    """Every class of the product's exception tree, found by its bases' names; only their modules are imported."""
    defined: dict[str, tuple[str, set[str]]] = {}
    for path in (path for room in ("rig", "pipeline", "calibration", "server") for path in (ROOT / room).rglob("*.py")):
        for node in ast.parse(path.read_text(encoding="utf-8")).body:
            if isinstance(node, ast.ClassDef):
                bases = {base.id for base in node.bases if isinstance(base, ast.Name)}
                defined[node.name] = ".".join(path.relative_to(ROOT).with_suffix("").parts), bases
    names, more = {"EigenheadError"}, {"EigenheadError"}
    while more:
        more = {name for name, (_, bases) in defined.items() if bases & names} - names
        names |= more
    return [getattr(importlib.import_module(defined[name][0]), name) for name in sorted(names)]


def made(kind: type[EigenheadError]) -> EigenheadError:
    """One of the class, with the parameters of the nearest class that ``problem_from`` reads."""
    error = kind.__new__(kind)
    if isinstance(error, Problem):
        Problem.__init__(error, 418, "kind", "what to do")
    elif isinstance(error, Refused):
        Refused.__init__(error, "kind", "what to do")
    elif isinstance(error, JobFailed):
        JobFailed.__init__(error, "kind", "what to do")
    elif isinstance(error, InputError):
        InputError.__init__(error, "subject", ["one"])
    else:
        EigenheadError.__init__(error, "what to do")
    return error


def test_every_refusal_has_its_status_and_so_has_a_class_below_it() -> None:
    assert set(STATUS_OF) == {Refused, *Refused.__subclasses__()}
    for kind, status in STATUS_OF.items():
        below_twice = type("BelowTwice", (type("Below", (kind,), {}),), {})
        for refusal in (kind, below_twice):
            error = refusal.__new__(refusal)
            Refused.__init__(error, "kind", "what to do", ["one", "two"], retry_after_s=7)
            problem = problem_from(error)
            assert (problem.status, problem.kind, texts_of(problem.errors)) == (status, "kind", ["one", "two"])
            assert problem.headers == {"Retry-After": "7"}


@pytest.mark.slow  # imports half of the product
def test_every_error_is_answered_and_so_is_a_class_below_it() -> None:
    classes = error_classes()
    assert len(classes) > 50
    for kind in classes:
        below = type(f"Below{kind.__name__}", (kind,), {})
        other = 418 if kind is Problem else 422 if issubclass(kind, InputError) else 500
        named = [each for each in kind.__mro__ if each in STATUS_OF]  # the nearest ancestor first
        expected = STATUS_OF[named[0]] if issubclass(kind, Refused) else other
        assert {problem_from(made(each)).status for each in (kind, below)} == {expected}, kind
