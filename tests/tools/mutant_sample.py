"""Mutation testing of compiled loops: `make mutants SAMPLE=50` changes 50 places of them, drawn at random, one at a
time, and tells which changes no test noticed. Ends with status 1 where fewer than 85 of 100 are noticed.

mutmut leaves functions with a decorator as they are, and compiled loops have one. Here each mutant is a copy of the
module with one operator or number changed, compiled as the loop itself is and run by the module's tests in a process
forked from one that has loaded the libraries. A mutant that takes five times the tests' own time, or ends the process,
is noticed.
"""

import argparse
import ast
import copy
import json
import os
import random
import signal
import subprocess
import sys
import tempfile
import time
from collections.abc import Iterator
from dataclasses import dataclass
from pathlib import Path

from tests.tools.mutants import KILLED_LEAST, ROOT

LEAST_S = 60.0  # a busy machine is no reason to call a mutant noticed
IMAGING, TEXTURE = "tests/pipeline/imaging", "tests/pipeline/texturing"
# The loops of geometry, silhouette cost and texture weights, and the tests that speak of them.
LOOPS = {
    "pipeline/geometry/projection_kernels.py": [f"{IMAGING}/test_projection.py", f"{IMAGING}/test_cpu_raster.py"],
    "pipeline/imaging/sampling_kernels.py": [f"{IMAGING}/test_sampling.py", f"{IMAGING}/test_contour_distance.py"],
    "pipeline/contour_fit/rim_kernels.py": [
        "tests/pipeline/contour_fit/test_rim.py",
        "tests/pipeline/estimation/test_jacobians.py",
    ],
    "pipeline/texturing/view_selection_kernels.py": [
        f"{TEXTURE}/test_visibility_kernels.py",
        f"{TEXTURE}/test_view_selection_kernels.py",
    ],
}
SWAPPED: dict[type[ast.AST], type[ast.AST]] = {
    **{ast.Lt: ast.LtE, ast.LtE: ast.Lt, ast.Gt: ast.GtE, ast.GtE: ast.Gt, ast.Eq: ast.NotEq, ast.NotEq: ast.Eq},
    **{ast.Add: ast.Sub, ast.Sub: ast.Add, ast.Mult: ast.Div, ast.Div: ast.Mult, ast.And: ast.Or, ast.Or: ast.And},
    **{ast.UAdd: ast.USub, ast.USub: ast.UAdd, ast.Continue: ast.Break, ast.Break: ast.Continue},
}


@dataclass(frozen=True, slots=True)
class Mutant:
    """One changed place: the module, the line and what stands there instead."""

    module: str
    line: int
    before: str
    after: str
    source: str


def is_compiled(node: ast.AST) -> bool:
    """A function under ``njit``."""
    return isinstance(node, ast.FunctionDef) and any("njit" in ast.unparse(mark) for mark in node.decorator_list)


def mutants_of(module: str) -> Iterator[Mutant]:
    """Every change of one place in the compiled functions of a module."""
    text = (ROOT / module).read_text(encoding="utf-8")
    tree = ast.parse(text)
    for place, function in enumerate(tree.body):
        if not is_compiled(function):
            continue
        assert isinstance(function, ast.FunctionDef)
        for number in range(len(list(_changed(function.body)))):
            body = copy.deepcopy(function.body)
            statement, line = _apply(body, number)
            before = ast.unparse(_statement_at(function.body, statement))
            after = ast.unparse(_statement_at(body, statement))
            whole = copy.deepcopy(tree)
            changed = whole.body[place]
            assert isinstance(changed, ast.FunctionDef)
            changed.body = body
            yield Mutant(module, line, before, after, ast.unparse(whole))


def _changed(body: list[ast.stmt]) -> Iterator[tuple[int, ast.AST, str, int]]:
    """(statement, node, field, index in it) of every place that can be changed."""
    for number, statement in enumerate(_statements(body)):
        for node in _own_nodes(statement):
            if isinstance(node, ast.Compare):
                yield from ((number, node, "ops", i) for i, op in enumerate(node.ops) if type(op) in SWAPPED)
            elif isinstance(node, ast.BinOp | ast.AugAssign | ast.BoolOp | ast.UnaryOp) and type(node.op) in SWAPPED:
                yield number, node, "op", 0
            elif isinstance(node, ast.Constant) and isinstance(node.value, bool | int | float):
                yield number, node, "value", 0
        if type(statement) in SWAPPED:
            yield number, statement, "itself", 0


def _statements(body: list[ast.stmt]) -> list[ast.stmt]:
    """All statements in their order, without documentation."""
    found = [node for statement in body for node in ast.walk(statement) if isinstance(node, ast.stmt)]
    found = [s for s in found if not (isinstance(s, ast.Expr) and isinstance(s.value, ast.Constant))]
    return sorted(found, key=lambda node: (node.lineno, node.col_offset))


def _own_nodes(statement: ast.stmt) -> Iterator[ast.AST]:
    """The statement and its expressions, without the statements inside it."""
    yield statement
    waiting = [child for child in ast.iter_child_nodes(statement) if not isinstance(child, ast.stmt)]
    while waiting:
        node = waiting.pop(0)
        yield node
        waiting.extend(ast.iter_child_nodes(node))


def _statement_at(body: list[ast.stmt], number: int) -> ast.stmt:
    """A statement; of one that holds others, its head alone."""
    statement = copy.deepcopy(_statements(body)[number])
    for field in ("body", "orelse"):
        if getattr(statement, field, None):
            setattr(statement, field, [ast.Pass()] if field == "body" else [])
    return statement


def _apply(body: list[ast.stmt], number: int) -> tuple[int, int]:
    """Makes the change with this number; returns its statement and line."""
    statement, node, field, index = list(_changed(body))[number]
    line = _statements(body)[statement].lineno
    if field == "ops":
        assert isinstance(node, ast.Compare)
        node.ops[index] = SWAPPED[type(node.ops[index])]()  # pyright: ignore[reportArgumentType, reportCallIssue]
    elif field == "op":
        setattr(node, "op", SWAPPED[type(getattr(node, "op"))]())  # noqa: B009, B010
    elif field == "value":
        assert isinstance(node, ast.Constant)
        node.value = (not node.value) if isinstance(node.value, bool) else node.value + 1  # pyright: ignore
    else:
        node.__class__ = SWAPPED[type(node)]
    return statement, line


def is_noticed(mutant: Mutant, folder: Path, tests: list[str], patience_s: float) -> bool:
    """Whether the tests fail with the mutant in its module's place, in a copy of the checkout."""
    path = folder / mutant.module
    before = path.read_bytes()
    path.write_text(mutant.source, encoding="utf-8")
    try:
        return run_tests(folder, tests, patience_s) != 0
    finally:
        path.write_bytes(before)


def run_tests(folder: Path, tests: list[str], patience_s: float) -> int:
    """The status of pytest in a fork of this process, which must not have loaded what it is to test."""
    pid = os.fork()
    if pid == 0:
        import pytest

        os.setpgid(0, 0)
        os.chdir(folder)
        sys.path[:] = [str(folder), *(place for place in sys.path if Path(place or ".").resolve() != ROOT)]
        for name in [name for name in sys.modules if name.partition(".")[0] == "tests"]:
            del sys.modules[name]
        ended, quiet = 1, os.open(os.devnull, os.O_WRONLY)
        os.dup2(quiet, 1)
        os.dup2(quiet, 2)
        try:
            ended = int(pytest.main(["-q", "-x", "-p", "no:cacheprovider", "-p", "no:xdist", *tests]))
        finally:
            os._exit(ended)
    until = time.monotonic() + patience_s
    while time.monotonic() < until:
        ended, status = os.waitpid(pid, os.WNOHANG)
        if ended:
            return os.waitstatus_to_exitcode(status)
        time.sleep(0.05)
    os.killpg(pid, signal.SIGKILL)
    os.waitpid(pid, 0)
    return -signal.SIGKILL


def copied(folder: Path) -> None:
    """The checkout as git knows it."""
    listed = ["git", "ls-files", "-z", "-co", "--exclude-standard"]
    names = subprocess.run(listed, cwd=ROOT, capture_output=True, text=True, check=True).stdout.split("\0")
    there = [name for name in names if name and (ROOT / name).is_file()]
    subprocess.run(["cp", "--parents", "-t", str(folder), *there], cwd=ROOT, check=True)


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("count", type=int, nargs="?", default=50, help="mutants drawn from all of the modules")
    parser.add_argument("--seed", type=int, default=1)
    parser.add_argument("--modules", nargs="+", default=sorted(LOOPS), help="only of these")
    arguments = parser.parse_args()
    every = [mutant for module in arguments.modules for mutant in mutants_of(module)]
    drawn = random.Random(arguments.seed).sample(every, min(arguments.count, len(every)))
    import cv2  # noqa: F401  before the forks: what every one of them needs
    import numba  # noqa: F401
    import pytest  # noqa: F401
    import scipy.ndimage  # noqa: F401
    import scipy.spatial  # noqa: F401

    sys.dont_write_bytecode = True
    noticed, patience_s = 0, dict[str, float]()
    with tempfile.TemporaryDirectory(prefix="eigenhead-mutants-") as scratch:
        folder = Path(scratch)
        copied(folder)
        for mutant in drawn:
            tests = LOOPS[mutant.module]
            if mutant.module not in patience_s:
                began = time.monotonic()
                if run_tests(folder, tests, 1200.0) != 0:
                    sys.exit(f"{mutant.module}: {' '.join(tests)} fail as they are")
                patience_s[mutant.module] = max(LEAST_S, 5 * (time.monotonic() - began))
            is_dead = is_noticed(mutant, folder, tests, patience_s[mutant.module])
            noticed += is_dead
            line = f"{'noticed ' if is_dead else 'SURVIVED'} {mutant.module}:{mutant.line}\n"
            sys.stdout.write(line if is_dead else f"{line}-  {mutant.before}\n+  {mutant.after}\n")
            sys.stdout.flush()
    figures = {"mutants": len(every), "tried": len(drawn), "noticed": noticed}
    sys.stdout.write(json.dumps({"figures": figures}) + "\n")
    sys.exit(noticed < KILLED_LEAST * len(drawn))


if __name__ == "__main__":
    main()
