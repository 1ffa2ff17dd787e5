"""The house rules hold, and the linter that checks them fires."""

import ast
import graphlib
import os
import re
import shutil
import subprocess
import sys
from functools import cache
from pathlib import Path

import pytest

ROOT = Path(__file__).resolve().parents[1]
ROOMS = ("rig", "pipeline", "calibration", "server")


def lint_imports(folder: Path) -> subprocess.CompletedProcess[str]:
    program = Path(sys.executable).with_name("lint-imports")
    environment = os.environ | {"PYTHONPATH": str(folder)}
    command = [str(program), "--no-cache"]
    return subprocess.run(
        command, cwd=folder, env=environment, capture_output=True, text=True, timeout=120, check=False
    )


@pytest.fixture
def copy(tmp_path: Path) -> Path:
    for room in ROOMS:
        shutil.copytree(ROOT / room, tmp_path / room, ignore=shutil.ignore_patterns("__pycache__", "*.npz"))
    shutil.copy(ROOT / "pyproject.toml", tmp_path)
    return tmp_path


def test_import_linter_finds_nothing(copy: Path) -> None:
    assert lint_imports(copy).returncode == 0


@pytest.mark.parametrize(
    ("module", "line", "contract"),
    [
        ("rig/mesh.py", "import pipeline.compute.threads", "Data flows"),
        ("pipeline/settings.py", "import calibration", "Data flows"),
        ("pipeline/settings.py", "import pydantic", "web framework"),
        ("pipeline/settings.py", "import moderngl", "OpenGL"),
    ],
)
def test_import_linter_fires_on_a_planted_violation(copy: Path, module: str, line: str, contract: str) -> None:
    with (copy / module).open("a") as file:
        file.write(f"\n{line}\n")
    outcome = lint_imports(copy)
    assert outcome.returncode == 1
    broken = [text for text in outcome.stdout.splitlines() if text.endswith("BROKEN")]
    assert len(broken) == 1
    assert contract in broken[0]


def test_the_product_imports_no_test_and_tests_do_without_the_laboratory() -> None:
    """The laboratory is run by hand: what a test needs of it belongs in tests/support."""
    forbidden = {path: "tests" for room in ROOMS for path in (ROOT / room).rglob("*.py")}
    forbidden |= {path: "tests.laboratory" for path in (ROOT / "tests").rglob("*.py")}
    beside = (ROOT / "tests" / "laboratory", ROOT / "tests" / "tools")
    found = {
        f"{path.relative_to(ROOT)}: {module}"
        for path, package in forbidden.items()
        if not any(folder in path.parents for folder in beside)
        for module in imported_modules(path)
        if f"{module}.".startswith(f"{package}.")
    }
    assert found == set()


def imported_modules(path: Path) -> set[str]:
    nodes = [*ast.walk(ast.parse(path.read_text(encoding="utf-8")))]
    froms = [node for node in nodes if isinstance(node, ast.ImportFrom) and node.module]
    names = {f"{node.module}.{alias.name}" for node in froms for alias in node.names}
    return names | {alias.name for node in nodes if isinstance(node, ast.Import) for alias in node.names}


def test_init_files_hold_a_docstring_and_nothing_else() -> None:
    for path in (path for room in ROOMS for path in (ROOT / room).rglob("__init__.py")):
        statements = ast.parse(path.read_text(encoding="utf-8")).body
        assert all(isinstance(statement, ast.Expr) for statement in statements), (
            f"{path}: each name has one import path"
        )


def test_no_room_is_called_utils() -> None:
    banned = {"utils", "util", "helpers", "common", "manager", "processor"}
    names = {path.stem for room in ROOMS for path in (ROOT / room).rglob("*")}
    assert not names & banned


def test_the_map_names_what_is_there() -> None:
    """Paths in docs/architecture.md exist, and so does every module that a room's lines name; capitals are classes."""
    text = (ROOT / "docs" / "architecture.md").read_text(encoding="utf-8")
    paths = re.findall(r"`([\w/]+/[\w.]+\.(?:py|txt|md))`", text)
    assert len(paths) > 10
    assert [path for path in paths if not (ROOT / path).exists()] == []
    gone = []
    rooms = re.findall(r"^- \*\*([\w/]+)\*\*:? (.*(?:\n  .*)*)$", text, re.MULTILINE)
    assert len(rooms) > 30
    for room, row in rooms:
        there = {path.stem for path in (ROOT / room).rglob("*")} | {"b_from_a"}
        gone += [f"{room}: {name}" for name in re.findall(r"`([a-z]\w*)`", row) if name not in there]
    assert gone == []


LINES_MOST, FUNCTION_MOST, PARAMETERS_MOST = 600, 60, 10
LONG_FOR_A_REASON = {
    "pipeline.segmentation.mask_kernels.solve_alpha": "one compiled loop: calls between would pass a dozen arrays",
    "pipeline.fusion.vote_kernels.vote": "one compiled loop over cells and views",
    "pipeline.stereo.depth_map_kernels.fit_planes": "one compiled loop with ten sums in registers",
}

MANY_FOR_A_REASON = {
    "server.cli.export.export": "each is an option of a command",
    "server.cli.heads.reconstruct": "each is an option of a command",
    "server.cli.batch.batch": "each is an option of a command",
    "server.cli.cameras.calibrate": "each is an option of a command",
    "server.http.routes.jobs.list_jobs": "each is a parameter of the query",
    "server.cli.simulate.simulate": "each is an option of a command",
}


@cache
def product_modules() -> dict[str, ast.Module]:
    files = [path for room in ROOMS for path in (ROOT / room).rglob("*.py")]
    names = [".".join(path.relative_to(ROOT).with_suffix("").parts) for path in files]
    return {name: ast.parse(path.read_text(encoding="utf-8")) for name, path in zip(names, files, strict=True)}


def functions(module: ast.Module) -> list[ast.FunctionDef | ast.AsyncFunctionDef]:
    return [node for node in ast.walk(module) if isinstance(node, ast.FunctionDef | ast.AsyncFunctionDef)]


def test_no_module_is_longer_than_a_room_should_be() -> None:
    lengths = {path: path.read_text(encoding="utf-8").count("\n") for r in ROOMS for path in (ROOT / r).rglob("*.py")}
    assert {str(path): lines for path, lines in lengths.items() if lines > LINES_MOST} == {}


def test_long_functions_and_many_parameters_have_a_reason() -> None:
    modules = product_modules().items()
    found = [(f"{name}.{function.name}", function) for name, module in modules for function in functions(module)]
    lines = {name: (function.end_lineno or 0) - function.lineno for name, function in found}
    assert {name for name, count in lines.items() if count >= FUNCTION_MOST} == set(LONG_FOR_A_REASON)
    many = {name for name, function in found if len(parameters(function)) > PARAMETERS_MOST}
    assert many == set(MANY_FOR_A_REASON)


def parameters(function: ast.FunctionDef | ast.AsyncFunctionDef) -> list[str]:
    """All but the object or class of a method."""
    arguments = function.args
    names = [each.arg for each in (*arguments.posonlyargs, *arguments.args, *arguments.kwonlyargs)]
    return names[1:] if names[:1] in (["self"], ["cls"]) else names


def test_no_two_modules_import_each_other() -> None:
    modules = product_modules()
    imports = {name: _imported(module, modules) for name, module in modules.items()}
    sorter = graphlib.TopologicalSorter(imports)
    sorter.prepare()  # raises CycleError with the modules of the cycle


def _imported(module: ast.Module, modules: dict[str, ast.Module]) -> set[str]:
    found = set()
    for node in ast.walk(module):
        if isinstance(node, ast.ImportFrom) and node.module:
            names = [f"{node.module}.{alias.name}" for alias in node.names]
            found |= {name if name in modules else node.module for name in names}
    return found & set(modules)


CALLABLE = "Callable[[str, float], None]"
# The task of a reconstruction still has an alias of its own.
PROGRESS_LEFT = {"server.tasks.child"}


def test_what_everybody_uses_is_defined_once() -> None:
    """Progress was defined 42 times (as Report), ImageRgb 17 times, and five modules asked difflib."""
    homes: dict[str, set[str]] = {
        "Progress": set(),
        "ImageRgb": set(),
        "difflib": set(),
        "Callable[[str, float], None]": set(),
    }
    for name, module in product_modules().items():
        for node in ast.walk(module):
            if isinstance(node, ast.Assign) and isinstance(node.targets[0], ast.Name):
                alias = {"Report": "Progress"}.get(node.targets[0].id, node.targets[0].id)
                homes.get(alias, set()).add(name)
            elif isinstance(node, ast.Subscript):
                homes.get(ast.unparse(node), set()).add(name)
            elif isinstance(node, ast.Import | ast.ImportFrom):
                names = [*(alias.name for alias in node.names), getattr(node, "module", None)]
                homes["difflib"] |= {name} if "difflib" in names else set()
    assert {key: found - PROGRESS_LEFT for key, found in homes.items()} == {
        "Progress": {"rig.progress"},
        "ImageRgb": {"rig.image"},
        "difflib": {"rig.text"},
        CALLABLE: {"rig.progress"},
    }
