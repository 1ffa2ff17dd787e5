"""Every code of a warning that the source can emit stands in a table, and in the operator's guide."""

import ast
from collections.abc import Iterator
from pathlib import Path

from pipeline.diagnostics import WARNING_CODES

ROOT = Path(__file__).resolve().parents[2]
CARRIERS = ("ReportWarning", "Remark", "Warned")  # what takes a code and a message


def test_every_emitted_code_is_listed_and_every_listed_code_is_emitted() -> None:
    emitted = {code for module in _modules() for code in _codes(module)}
    assert emitted == {*WARNING_CODES}


def test_every_listed_code_has_its_row_in_the_operators_guide_and_no_other_has() -> None:
    text = (
        (ROOT / "docs" / "operator.md").read_text(encoding="utf-8").split("## What the warnings mean")[1].split("##")[0]
    )
    firsts = [line.split("|")[1] for line in text.splitlines() if line.startswith("| `")]
    documented = [code.strip(" `") for first in firsts for code in first.split(",")]
    assert sorted(documented) == sorted(WARNING_CODES)


def _modules() -> Iterator[ast.Module]:
    for room in ("rig", "pipeline", "calibration", "server"):
        for path in (ROOT / room).rglob("*.py"):
            yield ast.parse(path.read_text(encoding="utf-8"))


def _codes(module: ast.Module) -> Iterator[str]:
    """What each warning that the module makes may have as its code, and what each property ``code`` returns."""
    for node in ast.walk(module):
        if isinstance(node, ast.Call) and isinstance(node.func, ast.Name) and node.func.id in CARRIERS:
            given = [word.value for word in node.keywords if word.arg == "code"] or node.args[:1]
            assert given, f"line {node.lineno}: a warning without a code"
            yield from _texts(given[0], module)
        if isinstance(node, ast.FunctionDef) and node.name == "code":
            for inner in ast.walk(node):
                if isinstance(inner, ast.Return) and inner.value is not None:
                    yield from _texts(inner.value, module)


def _texts(value: ast.expr, module: ast.Module) -> Iterator[str]:
    match value:
        case ast.Constant(str(text)):
            yield text
        case ast.IfExp():
            yield from _texts(value.body, module)
            yield from _texts(value.orelse, module)
        case ast.Name(name):
            bound = [
                node.value
                for node in ast.walk(module)
                if isinstance(node, ast.Assign) and any(isinstance(t, ast.Name) and t.id == name for t in node.targets)
            ]
            assert bound, f"line {value.lineno}: where does {name} come from?"
            for each in bound:
                yield from _texts(each, module)
        case ast.Attribute(attr="code") | ast.Subscript(slice=ast.Constant("code")):
            return  # another warning's, or a property's: counted where that is made
        case _:
            raise AssertionError(f"line {value.lineno}: a code that cannot be read: {ast.unparse(value)}")
