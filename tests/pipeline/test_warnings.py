"""Every code of a warning that the source can emit stands in a table, and in the operator's guide."""

import ast
from collections.abc import Iterator
from pathlib import Path

from pipeline.warnings import WARNING_CODES

ROOT = Path(__file__).resolve().parents[2]
ROOMS = ("rig", "pipeline", "calibration", "server")
PARTS = {
    *("feature-view-missing", "feature-left-out", "feature-contradictory", "feature-view-contradicts"),  # features
    *("view-unused", "located"),  # view-left-out
    "names-and-more",  # face-elsewhere
    *("pictures-distorted", "pictures-undistorted", "principal-points-counted"),  # lens-doubtful
    *("outlines-inside", "outlines-outside"),  # masks-off-edges
}
"""What becomes a parameter of a warning."""


def test_every_warning_that_a_stage_returns_is_listed_and_every_listed_code_is_emitted() -> None:
    returned = {code for module in _modules("pipeline") for code in _told(module)}
    assert returned - PARTS - {*WARNING_CODES} == set()
    assert len(returned) > 20
    emitted = {code for module in _modules(*ROOMS) for code in _composed(module)}
    assert {*WARNING_CODES} - emitted == set()


def test_every_listed_code_has_its_row_in_the_operators_guide_and_no_other_has() -> None:
    text = (
        (ROOT / "docs" / "operator.md").read_text(encoding="utf-8").split("## What the warnings mean")[1].split("##")[0]
    )
    firsts = [line.split("|")[1] for line in text.splitlines() if line.startswith("| `")]
    documented = [code.strip(" `") for first in firsts for code in first.split(",")]
    assert sorted(documented) == sorted(WARNING_CODES)


def _modules(*rooms: str) -> Iterator[ast.Module]:
    for room in rooms:
        for path in (ROOT / room).rglob("*.py"):
            yield ast.parse(path.read_text(encoding="utf-8"))


def _told(module: ast.Module) -> Iterator[str]:
    """What functions that return ``ReportWarning`` compose, and what is added to something called ``warnings``."""
    for node in ast.walk(module):
        match node:
            case ast.FunctionDef(returns=ast.expr() as returns) if "ReportWarning" in ast.unparse(returns):
                yield from _composed(node)
            case ast.Call(func=ast.Attribute(value=to, attr="append" | "extend")) if "warnings" in ast.unparse(to):
                yield from _composed(node)


def _composed(node: ast.AST) -> Iterator[str]:
    """The codes of the messages under the node that are no parameter of another."""
    match node:
        case ast.Call(func=ast.Name("compose"), args=[code, *_]):
            for option in [code.body, code.orelse] if isinstance(code, ast.IfExp) else [code]:
                if isinstance(option, ast.Constant):
                    yield str(option.value)
        case _:
            for child in ast.iter_child_nodes(node):
                yield from _composed(child)
