"""Annotations as checks: what `make test-shapes` holds every call of rig, pipeline and calibration to.

beartype checks each value once, its shape by jaxtyping's types. jaxtyping's own import hook does the same, but binds
every call's arguments to a signature and checks them a second time with the answer: measured on a calibration of many
small calls, its checks cost 130 % of the work itself, these 50 %.
"""

import ast
import inspect
import sys
from collections.abc import Callable, Iterable
from dataclasses import is_dataclass
from functools import wraps
from importlib.abc import MetaPathFinder
from importlib.machinery import ModuleSpec, PathFinder, SourceFileLoader
from pathlib import Path
from typing import Any, ForwardRef, get_args

from beartype import BeartypeConf, beartype
from jaxtyping import AbstractArray, jaxtyped

ROOT = Path(__file__).resolve().parents[2]

# PEP 484: where a float is wanted a whole number will do.
check_types = beartype(conf=BeartypeConf(is_pep484_tower=True))


def checked_modules() -> list[str]:
    """The modules whose annotations, shapes included, every call in the tests must obey: all of rig, pipeline and
    calibration but compiled loops (``*_kernels.py``), which a wrapped function would break."""
    files = [path for room in ("rig", "pipeline", "calibration") for path in (ROOT / room).rglob("*.py")]
    plain = [path for path in files if path.name != "__init__.py" and not path.stem.endswith("_kernels")]
    return [".".join(path.relative_to(ROOT).with_suffix("").parts) for path in plain]


def checked(decorated: Any) -> Any:
    """``decorated`` (a function, a method of any kind, or a class) so that each call checks arguments and answer. The
    letters of shapes mean one size each within one call. Of a class only a dataclass's own ``__init__`` is left to
    check: its methods were when it was made."""
    match decorated:
        case type():
            if is_dataclass(decorated) and "__init__" in vars(decorated):
                decorated.__init__ = checked(decorated.__init__)
            return decorated
        case classmethod() | staticmethod():
            return type(decorated)(checked(decorated.__func__))
        case property():
            parts = (decorated.fget, decorated.fset, decorated.fdel)
            return property(*(part and checked(part) for part in parts))
        case _:
            return _checked_function(decorated)


def _checked_function(function: Callable[..., Any]) -> Any:
    typed = check_types(function)
    if not any(_has_shape(annotation) for annotation in function.__annotations__.values()):
        return typed
    one_call = jaxtyped("context")

    @wraps(function)
    def call(*args: Any, **named: Any) -> Any:
        with one_call:
            return typed(*args, **named)

    return call


def _has_shape(annotation: Any) -> bool:
    if isinstance(annotation, str | ForwardRef):  # not looked up: it may have one
        return True
    if inspect.isclass(annotation) and issubclass(annotation, AbstractArray):
        return True
    parts = annotation if isinstance(annotation, list | tuple) else get_args(annotation)
    return any(_has_shape(part) for part in parts)


class _Decorate(ast.NodeVisitor):
    """Writes ``checked`` above every class and below every other decorator of a function."""

    def visit_ClassDef(self, node: ast.ClassDef) -> None:
        node.decorator_list.insert(0, self._decorator(node))
        self.generic_visit(node)

    def visit_FunctionDef(self, node: ast.FunctionDef) -> None:
        node.decorator_list.append(self._decorator(node))
        self.generic_visit(node)

    @staticmethod
    def _decorator(node: ast.AST) -> ast.expr:
        name = f"__import__('sys').modules[{__name__!r}].checked"
        return ast.copy_location(ast.parse(name, mode="eval").body, node)


class _CheckingLoader(SourceFileLoader):
    def get_code(self, fullname: str) -> Any:
        """Compiled anew each time: the kept bytecode is that of the plain module."""
        path = self.get_filename(fullname)
        tree = ast.parse(self.get_data(path), path)
        _Decorate().visit(tree)
        return compile(ast.fix_missing_locations(tree), path, "exec", dont_inherit=True)


class _CheckingFinder(MetaPathFinder):
    def __init__(self, modules: Iterable[str]) -> None:
        self.modules = frozenset(modules)

    def find_spec(self, fullname: str, path: Any, target: Any = None) -> ModuleSpec | None:
        found = PathFinder.find_spec(fullname, path, target) if fullname in self.modules else None
        if found is None or not isinstance(found.loader, SourceFileLoader):
            return None
        found.loader = _CheckingLoader(found.loader.name, found.loader.path)
        return found


def check_imports(modules: Iterable[str]) -> None:
    """From now on ``modules`` are imported with ``checked`` written over every function and class."""
    sys.meta_path.insert(0, _CheckingFinder(modules))
