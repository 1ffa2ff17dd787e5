"""The rooms of server hold by themselves: the order of imports is told to import-linter, the sizes are counted here."""

import ast
from pathlib import Path

import pytest

from rig.messages.message import texts_of
from server.errors import Refused
from server.wire.problems import STATUS_OF, problem_from

ROOT = Path(__file__).resolve().parents[2] / "server"


def test_every_refusal_has_its_status() -> None:
    assert set(STATUS_OF) == {Refused, *Refused.__subclasses__()}
    for kind, status in STATUS_OF.items():
        error = kind.__new__(kind)
        Refused.__init__(error, "kind", "what to do", ["one", "two"], retry_after_s=7)
        problem = problem_from(error)
        assert (problem.status, problem.kind, texts_of(problem.errors)) == (status, "kind", ["one", "two"])
        assert problem.headers == {"Retry-After": "7"}


@pytest.mark.parametrize("path", sorted(ROOT.rglob("*.py")), ids=lambda path: path.relative_to(ROOT).as_posix())
def test_no_module_and_no_function_is_long(path: Path) -> None:
    text = path.read_text()
    assert text.count("\n") < 600
    for node in ast.walk(ast.parse(text)):
        if isinstance(node, ast.FunctionDef | ast.AsyncFunctionDef):
            assert (node.end_lineno or 0) - node.lineno < 61 or node.name == "simulate", node.name
