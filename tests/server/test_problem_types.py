"""The types of problems and failures are those of the table."""

import ast
import importlib
import pkgutil
from collections.abc import Iterator
from pathlib import Path
from string import ascii_lowercase

import calibration
import pipeline
import rig.formats
import rig.render
import server
from rig.errors import Cancelled, EigenheadError, InputError
from server.errors import NotFound, Refused
from server.problem_types import FAILURE_TYPES, HTTP_TYPES, INPUT_TYPES, PROBLEM_TYPES, type_of_failure, type_of_input

KIND_IN = {
    "Problem": 1,
    "JobFailed": 0,
    **{kind.__name__: 0 for kind in Refused.__subclasses__() if kind is not NotFound},
}
"""Where the type stands among the arguments."""


def test_every_type_that_the_service_gives_is_in_the_table_and_no_other_is() -> None:
    types = {*_given(), *INPUT_TYPES.values(), *FAILURE_TYPES.values(), *HTTP_TYPES.values()}
    types |= {type_of_input("someone's file"), type_of_failure("Unheard"), "http-error"}
    assert types == PROBLEM_TYPES.keys()


def test_every_error_that_may_end_a_job_has_its_type() -> None:
    for package in (calibration, pipeline, rig.formats, rig.render):
        for module in pkgutil.walk_packages(package.__path__, package.__name__ + "."):
            importlib.import_module(module.name)
    classes = {kind for kind in _descendants(EigenheadError) if not issubclass(kind, InputError | Cancelled)}
    rooms = ("calibration.", "pipeline.", "rig.formats.", "rig.render.")
    found = {kind.__name__ for kind in classes if kind.__module__.startswith(rooms)}
    assert found - FAILURE_TYPES.keys() == set()
    assert FAILURE_TYPES.keys() - found == {
        *("EigenheadError", "ShotFailed"),
        *("bug", "crash", "disk-full", "killed", "out-of-memory"),
    }


def test_every_type_is_a_lower_case_name_with_a_title() -> None:
    for kind, title in PROBLEM_TYPES.items():
        assert set(kind) <= {*ascii_lowercase, "-"}
        assert title[0].isupper()


def _given() -> Iterator[str]:
    """The types written out where the service refuses something or answers with a failure."""
    for path in Path(server.__path__[0]).rglob("*.py"):
        for node in ast.walk(ast.parse(path.read_text(encoding="utf-8"))):
            match node:
                case ast.Call(func=ast.Name(name), args=args) if name in KIND_IN and len(args) > KIND_IN[name]:
                    yield from _texts(args[KIND_IN[name]])
                case ast.Call(func=ast.Attribute(value=ast.Call(func=ast.Name("super"))), args=[ast.Constant(a), *_]):
                    yield from [a] if a in PROBLEM_TYPES else []
                case ast.BinOp(left=ast.Name("URN"), right=right):
                    yield from _texts(right)


def _texts(value: ast.expr) -> Iterator[str]:
    for node in ast.walk(value):
        if isinstance(node, ast.Constant) and isinstance(node.value, str):
            yield node.value


def _descendants(kind: type) -> Iterator[type]:
    for child in kind.__subclasses__():
        yield child
        yield from _descendants(child)
