"""Counts what the project is made of: ``python -m tests.tools.counts [CHECKOUT] [--json|--list]``.

Prints, for each room of the product, for the tests and for the laboratory, the modules, lines and functions; and over
the product the modules with a single importer in their own folder, settings, numeric constants, loops that solve least
squares outside their rooms, and the pages and words of the documents. tests/test_size.py holds the totals to a ceiling
that may only fall.
"""

import ast
import json
import re
import sys
from collections import defaultdict
from collections.abc import Container, Iterable, Iterator
from dataclasses import asdict, dataclass
from functools import cache
from pathlib import Path

ROOT = Path(__file__).resolve().parents[2]
PRODUCT = ("rig", "calibration", "pipeline", "server")
SOLVERS = ("solve", "lstsq", "lsq_linear", "cho_solve", "solveh_banded", "spsolve", "factorized", "splu")
DEFINITION = re.compile(r"^ *(?:async )?def ", re.MULTILINE)
SOLVER_ROOMS = ("pipeline.estimation.", "pipeline.geometry.registration")
MOMENTS = (
    *("pipeline.applications.moments", "server.cli.moments", "server.services.live", "server.tasks.moving_subject"),
    *("server.tasks.film", "tests.server.tasks.test_film", "tests.server.http.test_films"),
    *("rig.messages.english.live", "server.http.routes.live", "tests.laboratory.experiments.moments"),
    *("tests.pipeline.applications.moments", "tests.server.services.live"),
)  # new ground, counted apart: what the ceilings hold has none of it
PARTS = ("product", "tests", "tests.laboratory")


@dataclass(frozen=True, slots=True)
class Size:
    """Holds the size of one room."""

    modules: int
    lines: int
    functions: int


@dataclass(frozen=True, slots=True)
class Module:
    """Holds where a module is and its text."""

    path: Path
    text: str


@cache
def read_modules(root: Path = ROOT, rooms: tuple[str, ...] = PRODUCT) -> dict[str, Module]:
    """Returns the modules of ``rooms`` by their dotted names."""
    modules = {}
    for path in (path for room in rooms for path in sorted((root / room).rglob("*.py"))):
        name = ".".join(path.relative_to(root).with_suffix("").parts).removesuffix(".__init__")
        modules[name] = Module(path, path.read_text(encoding="utf-8"))
    return modules


@cache
def parse_modules(root: Path = ROOT) -> dict[str, ast.Module]:
    """Returns the syntax trees of the product's modules by their dotted names."""
    return {name: ast.parse(module.text) for name, module in read_modules(root).items()}


def measure(modules: Iterable[Module]) -> Size:
    """Returns the size of ``modules``."""
    texts = [module.text for module in modules]
    return Size(
        len(texts), sum(text.count("\n") for text in texts), sum(len(DEFINITION.findall(text)) for text in texts)
    )


def measure_rooms(root: Path = ROOT) -> dict[str, Size]:
    """Returns the size of each room of the product, of the ``PARTS``, and of those of ``MOMENTS``."""
    rooms: dict[str, list[Module]] = {room: [] for part in PARTS for room in (part, f"moments {part}")}
    for name, module in read_modules(root, (*PRODUCT, "tests")).items():
        top, *inner = name.split(".")
        part = PARTS[0] if top != "tests" else PARTS[2] if inner[:1] == ["laboratory"] else PARTS[1]
        names = [f"moments {part}" if name.startswith(MOMENTS) else part]
        if names == ["product"]:
            names += [f"{top} (all)", f"{top}.{inner[0]}" if inner and (root / top / inner[0]).is_dir() else top]
        for room in names:
            rooms.setdefault(room, []).append(module)
    return {room: measure(modules) for room, modules in sorted(rooms.items())}


def list_imports(root: Path = ROOT) -> dict[str, set[str]]:
    """Returns the modules of the product that each module imports."""
    modules = parse_modules(root)
    return {name: set(_imported(tree, modules)) - {name} for name, tree in modules.items()}


def _imported(tree: ast.Module, modules: Container[str]) -> Iterator[str]:
    for node in ast.walk(tree):
        if isinstance(node, ast.ImportFrom) and node.module:
            for alias in node.names:
                inner = f"{node.module}.{alias.name}"
                yield from (name for name in (inner, node.module) if name in modules)
        elif isinstance(node, ast.Import):
            yield from (alias.name for alias in node.names if alias.name in modules)


def list_single_importers(root: Path = ROOT) -> list[str]:
    """Returns the modules that exactly one module imports, one of their own folder. Packages do not count."""
    importers: dict[str, set[str]] = defaultdict(set)
    for name, imports in list_imports(root).items():
        for imported in imports:
            importers[imported].add(name)
    paths = {name: module.path for name, module in read_modules(root).items()}
    single = []
    for name, path in paths.items():
        if len(importers[name]) == 1 and path.name != "__init__.py" and not name.startswith(MOMENTS):
            (importer,) = importers[name]
            if paths[importer].parent == path.parent:
                single.append(name)
    return sorted(single)


def count_settings(root: Path = ROOT) -> int:
    """Returns how many values a user can set in ``pipeline/settings.py``; a group of settings is none."""
    tree = ast.parse((root / "pipeline" / "settings.py").read_text(encoding="utf-8"))
    classes = [node for node in tree.body if isinstance(node, ast.ClassDef)]
    names = {node.name for node in classes}
    fields = [each for node in classes for each in node.body if isinstance(each, ast.AnnAssign)]
    read = [each for each in fields if "metadata" not in ast.unparse(each)]  # the others are the reader's
    return sum(ast.unparse(each.annotation) not in names for each in read)


def count_constants(root: Path = ROOT) -> int:
    """Returns how many numbers the modules of the product name by constants."""
    return sum(
        len(_numbers(statement))
        for tree in parse_modules(root).values()
        for statement in tree.body
        if isinstance(statement, ast.Assign | ast.AnnAssign)
    )


def _numbers(statement: ast.Assign | ast.AnnAssign) -> list[str]:
    target = statement.targets[0] if isinstance(statement, ast.Assign) else statement.target
    names = target.elts if isinstance(target, ast.Tuple) else [target]
    values = statement.value.elts if isinstance(statement.value, ast.Tuple) and len(names) > 1 else [statement.value]
    pairs = zip(names, values, strict=False)
    return [ast.unparse(name) for name, value in pairs if value is not None and _is_number(value)]


def _is_number(value: ast.expr) -> bool:
    leaves = [node.value for node in ast.walk(value) if isinstance(node, ast.Constant)]
    plain = not isinstance(value, ast.Dict | ast.List | ast.Set | ast.Call)
    return plain and bool(leaves) and all(type(leaf) in (int, float) for leaf in leaves)


def list_solver_loops(root: Path = ROOT) -> list[str]:
    """Returns the functions outside the solvers' rooms that solve linear systems in a loop."""
    found = []
    for name, tree in parse_modules(root).items():
        if name.startswith(SOLVER_ROOMS):
            continue
        for function in ast.walk(tree):
            if isinstance(function, ast.FunctionDef) and any(map(_solves, _loops(function))):
                found.append(f"{name}.{function.name}")
    return sorted(set(found))


def _loops(function: ast.FunctionDef) -> list[ast.AST]:
    return [node for node in ast.walk(function) if isinstance(node, ast.For | ast.While)]


def _solves(loop: ast.AST) -> bool:
    calls = [node.func for node in ast.walk(loop) if isinstance(node, ast.Call)]
    return any(getattr(call, "attr", getattr(call, "id", "")) in SOLVERS for call in calls)


def count_documents(root: Path = ROOT) -> tuple[int, int]:
    """Returns the pages and the words under docs/."""
    texts = [path.read_text(encoding="utf-8") for path in sorted((root / "docs").rglob("*.md"))]
    return len(texts), sum(len(re.findall(r"\S+", text)) for text in texts)


def count_all(root: Path = ROOT) -> dict[str, int]:
    """Returns the totals that tests/test_size.py holds."""
    sizes, (pages, words) = measure_rooms(root), count_documents(root)
    return {
        "product_lines": sizes["product"].lines,
        "product_modules": sizes["product"].modules,
        "test_lines": sizes["tests"].lines,
        "laboratory_lines": sizes["tests.laboratory"].lines,
        "settings": count_settings(root),
        "constants": count_constants(root),
        "single_importer_modules": len(list_single_importers(root)),
        "solver_loops": len(list_solver_loops(root)),
        "pages": pages,
        "words": words,
        **{room: size.lines for room, size in sizes.items() if room.startswith("moments")},
    }


def main() -> None:
    """Prints the counts of the folder that is named, or of this checkout."""
    root = next((Path(each).resolve() for each in sys.argv[1:] if not each.startswith("-")), ROOT)
    rooms, totals = measure_rooms(root), count_all(root)
    if "--json" in sys.argv:
        document = {"rooms": {room: asdict(size) for room, size in rooms.items()}, "figures": totals}
        sys.stdout.write(json.dumps(document) + "\n")
        return
    lines = [f"{'room':<32}{'modules':>8}{'lines':>8}{'functions':>10}"]
    lines += [f"{room:<32}{size.modules:>8}{size.lines:>8}{size.functions:>10}" for room, size in rooms.items()]
    lines += [f"{name:<32}{value:>8}" for name, value in totals.items()]
    if "--list" in sys.argv:
        lines += ["modules that one neighbour imports:", *list_single_importers(root)]
        lines += ["functions that solve in a loop:", *list_solver_loops(root)]
    sys.stdout.write("\n".join(lines) + "\n")


if __name__ == "__main__":
    main()
