"""Sentences in the product's code: where messages are composed, and where text is still raw."""

import ast
import re
from collections.abc import Iterator
from functools import cache
from pathlib import Path

ROOT = Path(__file__).parents[2]
ROOMS = ("rig", "calibration", "pipeline", "server")
ENGLISH = ROOT / "rig" / "messages" / "english"
SENTENCE = re.compile(r"(?=.*[a-z]{2})(.*[A-Za-z]{2,}[,.:;']? [a-z({\d']|[a-z]+ \{|.*\} [a-z]{2,})", re.DOTALL)
COLLECTED = re.compile(r"(\w+\.)?_?(faults|warnings|remarks|reasons|severe|mild|fatal|notes|doubts)$")
# Errors of Python and of libraries, which no operator reads, and of a page's or a command line's own.
NOT_OURS = {
    *("ValueError", "TypeError", "KeyError", "RuntimeError", "NotImplementedError", "AssertionError", "OSError"),
    *("FileExistsError", "IsADirectoryError", "NotADirectoryError", "SystemExit", "BadParameter"),
    *("PydanticCustomError", "AravisError"),
}


@cache
def modules() -> dict[Path, ast.Module]:
    paths = (path for room in ROOMS for path in sorted((ROOT / room).rglob("*.py")) if ENGLISH not in path.parents)
    return {path: ast.parse(path.read_text(encoding="utf-8")) for path in paths}


def composed(tree: ast.Module) -> Iterator[tuple[int, set[str], set[str] | None]]:
    """Line, codes and parameters of every ``compose(...)``; no parameters where the code is a variable, which is then
    any constant of the function."""
    for scope in _scopes(tree):
        calls = [node for node in scope if isinstance(node, ast.Call) and _name(node.func) == "compose"]
        for call in calls:
            code, parameters = call.args[0], {str(keyword.arg) for keyword in call.keywords}
            if isinstance(code, ast.Constant):
                yield call.lineno, {str(code.value)}, parameters
            elif isinstance(code, ast.IfExp):
                yield call.lineno, {ast.literal_eval(code.body), ast.literal_eval(code.orelse)}, parameters
            else:
                constants = (node.value for node in scope if isinstance(node, ast.Constant))
                yield call.lineno, {text for text in constants if isinstance(text, str)}, None


def raw_sentences(tree: ast.Module) -> list[tuple[int, str]]:
    """Line and text of every sentence that reaches an error of ours, or a collection of faults or warnings, as text."""
    found: dict[int, tuple[int, str]] = {}
    for scope in _scopes(tree):
        sinks = [sink for node in scope for sink in _sinks(node)]
        names = {node.id for sink in sinks for node in ast.walk(sink) if isinstance(node, ast.Name)}
        assigned = [node.value for node in scope if isinstance(node, ast.Assign) and _targets(node) & names]
        for sink in (*sinks, *assigned):
            found |= {id(node): (node.lineno, text) for node, text in _texts(sink)}
    return sorted(found.values())


def _scopes(tree: ast.Module) -> list[list[ast.AST]]:
    """The nodes of the module, and of each function, without those of functions within."""
    scopes: list[list[ast.AST]] = []

    def gather(node: ast.AST, scope: list[ast.AST]) -> None:
        for child in ast.iter_child_nodes(node):
            if isinstance(child, ast.FunctionDef | ast.AsyncFunctionDef):
                scopes.append([])
                gather(child, scopes[-1])
            else:
                scope.append(child)
                gather(child, scope)

    scopes.append([])
    gather(tree, scopes[0])
    return scopes


def _name(node: ast.AST) -> str:
    return node.attr if isinstance(node, ast.Attribute) else node.id if isinstance(node, ast.Name) else ""


def _targets(node: ast.Assign) -> set[str]:
    return {target.id for target in node.targets if isinstance(target, ast.Name)}


def _sinks(node: ast.AST) -> Iterator[ast.AST]:
    if isinstance(node, ast.Raise) and isinstance(node.exc, ast.Call) and _name(node.exc.func) not in NOT_OURS:
        yield from _told(node.exc)
    if isinstance(node, ast.Call):
        of, name = node.func, _name(node.func)
        if name in ("append", "extend") and isinstance(of, ast.Attribute) and COLLECTED.match(ast.unparse(of.value)):
            yield from node.args
        if name == "__init__" or name in ("Fault", "Detail", "Check", "Dropped", "Removal", "InputError"):
            yield from _told(node)
    if isinstance(node, ast.AugAssign) and COLLECTED.match(ast.unparse(node.target)):
        yield node.value
    if isinstance(node, ast.Assign) and any(COLLECTED.match(ast.unparse(target)) for target in node.targets):
        yield node.value


def _told(call: ast.Call) -> Iterator[ast.AST]:
    """What a call is told, but for the subject before it, and the headers beside it."""
    keywords = (keyword.value for keyword in call.keywords if keyword.arg != "headers")
    named = len(call.args) > 1 and _name(call.func) in ("InputError", "Check")
    yield from (*call.args[named:], *keywords)


def _texts(sink: ast.AST) -> Iterator[tuple[ast.expr, str]]:
    """Sentences in an expression, but for those that a call is given: it makes something else of them."""
    if isinstance(sink, ast.JoinedStr):
        text = "".join(str(v.value) if isinstance(v, ast.Constant) else "{}" for v in sink.values)
        if SENTENCE.match(text):
            yield sink, text
    elif isinstance(sink, ast.Constant):
        if isinstance(sink.value, str) and SENTENCE.match(sink.value):
            yield sink, sink.value
    elif isinstance(sink, ast.Call):
        if _name(sink.func) in ("join", "InputError", "str", "filter", "tuple", "list"):
            for argument in sink.args:
                yield from _texts(argument)
    else:
        for child in ast.iter_child_nodes(sink):
            if isinstance(child, ast.expr | ast.comprehension):
                yield from _texts(child)
