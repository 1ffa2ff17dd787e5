"""How the wheel carries the packages: under one name of their own, `eigenhead`.

In the checkout the folders rig, pipeline, calibration and server are imported by those names. Other people's code uses
them too, so a wheel must not own them: this build hook copies each module to `eigenhead/<its path>` and writes the
imports so that they say where the module then is (`from rig.camera import Camera` becomes
`from eigenhead.rig.camera import Camera`). Nothing else in a file changes, neither a line number. What cannot be moved
like that (a module named in a string, `import rig.camera`) ends the build with its file and line.

With EIGENHEAD_WHEEL_LOOPS=1 the wheel also carries the loops of a job compiled, for
`rig.jit.PORTABLE_CPU`, and the Python and Numba of the environment that builds (`uv build --wheel
--no-build-isolation`); with others they are not found, and compiled as from any other wheel.

The package `eigenhead` itself is written here, for the wheel and for the checkout's own environment: the names of
`[tool.hatch.build.targets.wheel.hooks.custom.public]` in pyproject.toml, each imported when it is first asked for.
"""

import ast
import os
import re
import shutil
import subprocess
import sys
import tempfile
from collections.abc import Iterator, Mapping
from pathlib import Path
from typing import Any

from hatchling.builders.hooks.plugin.interface import BuildHookInterface

WHEEL_PACKAGE = "eigenhead"
PACKAGES = ("rig", "pipeline", "calibration", "server")
LOOPS = "EIGENHEAD_WHEEL_LOOPS"
COMPILE_S = 1800.0  # the longest that compiling may take
NOT_CARRIED = shutil.ignore_patterns("__pycache__", "*.nbi", "*.nbc")

_MODULE_NAME = re.compile(rf"({'|'.join(PACKAGES)})((\.\w+)*)\.?(:\w*)?")
_FROM = re.compile(rb"from\s+")


class ImportCannotMove(Exception):
    """An import, or a string that names a module, which would still mean the checkout's place in the wheel."""

    def __init__(self, path: Path, line: int, why: str) -> None:
        super().__init__(f"{path}:{line}: {why}")


class WheelImports(BuildHookInterface):
    """Hatchling's entry: makes the files of a wheel, or the package `eigenhead` of an editable installation."""

    PLUGIN_NAME = "custom"

    def initialize(self, version: str, build_data: dict[str, Any]) -> None:
        """Makes the package `eigenhead` in a temporary folder, and tells Hatchling to take it into the wheel."""
        self._scratch = Path(tempfile.mkdtemp(prefix="eigenhead-wheel-"))
        public: Mapping[str, str] = self.config.get("public", {})
        package = self._scratch / WHEEL_PACKAGE
        package.mkdir()
        root = Path(self.root)
        if version == "editable":
            write_facade(package, public, checkout=root)
            build_data["force_include_editable"] = {str(package): WHEEL_PACKAGE}
        else:
            write_facade(package, public)
            carry_packages(root, package)
            if os.environ.get(LOOPS):
                carry_loops(package)
            build_data["force_include"] = {str(package): WHEEL_PACKAGE}

    def finalize(self, version: str, build_data: dict[str, Any], artifact_path: str) -> None:
        """Removes the temporary folder."""
        shutil.rmtree(self._scratch)


def carry_packages(root: Path, target: Path) -> None:
    """Copies the four packages from the checkout `root` into `target`, with their imports moved.

    Raises:
        ImportCannotMove: see the module.
    """
    for name in PACKAGES:
        shutil.copytree(root / name, target / name, ignore=NOT_CARRIED)
    for path in sorted(target.rglob("*.py")):
        if path != target / "__init__.py" and path != target / "__main__.py":
            place = path.relative_to(target)
            path.write_bytes(moved_imports(path.read_bytes(), place, target))


def carry_loops(package: Path) -> None:
    """Compiles the loops of a job, as this copy of the code defines them, into the copy.

    Raises:
        subprocess.CalledProcessError: where the Python that builds cannot (it lacks Numba, say).
    """
    with tempfile.TemporaryDirectory(prefix="eigenhead-loops-") as cache:
        environment = os.environ | {"PYTHONPATH": str(package.parent), "EIGENHEAD_CACHE": cache}
        command = [sys.executable, "-P", "-m", WHEEL_PACKAGE, "prepare"]
        subprocess.run(command, env=environment, check=True, timeout=COMPILE_S)
        shutil.copytree(Path(cache) / "kernels", package / "rig" / "compiled_loops")
    for left in package.rglob("__pycache__"):
        shutil.rmtree(left)


def moved_imports(source: bytes, place: Path, packages: Path) -> bytes:
    """The source of one module with the imports of the four packages under `eigenhead`.

    Args:
        source: UTF-8.
        place: the module's path below the checkout, for messages.
        packages: folder that holds the four packages, to tell a module's name from other text.

    Raises:
        ImportCannotMove: see the module.
    """
    lines = source.splitlines(keepends=True)
    for node in ast.walk(ast.parse(source)):
        if isinstance(node, ast.ImportFrom) and node.level == 0 and _is_ours(node.module or ""):
            line = lines[node.lineno - 1]
            found = _FROM.match(line, node.col_offset)
            if found is None:
                raise ImportCannotMove(place, node.lineno, "no module's name on the line of `from`")
            lines[node.lineno - 1] = line[: found.end()] + f"{WHEEL_PACKAGE}.".encode() + line[found.end() :]
        elif isinstance(node, ast.Import):
            for alias in node.names:
                if _is_ours(alias.name):
                    raise ImportCannotMove(place, node.lineno, f"write `from ... import` for `import {alias.name}`")
        elif isinstance(node, ast.Constant) and isinstance(node.value, str) and _names_module(node.value, packages):
            raise ImportCannotMove(place, node.lineno, f"{node.value!r} names a module; derive it from __package__")
    return b"".join(lines)


def write_facade(package: Path, public: Mapping[str, str], checkout: Path | None = None) -> None:
    """Writes `eigenhead/__init__.py`, `__main__.py` and `py.typed`.

    Args:
        package: the folder `eigenhead`.
        public: the checkout's module of each public name.
        checkout: where an editable installation finds the packages; None for a wheel, which holds them.
    """
    prefix = "" if checkout else f"{WHEEL_PACKAGE}."
    (package / "__init__.py").write_text("\n".join(_facade_lines(prefix, public, checkout)) + "\n", encoding="utf-8")
    (package / "__main__.py").write_text(
        f'from {prefix}server.cli.main import main\n\nif __name__ == "__main__":\n    main()\n', encoding="utf-8"
    )
    (package / "py.typed").touch()


def _facade_lines(prefix: str, public: Mapping[str, str], checkout: Path | None) -> Iterator[str]:
    yield '"""One shot of a calibrated camera rig in, a textured 3D head with its uncertainty out."""'
    yield ""
    yield "import importlib"
    if checkout is not None:
        yield "import sys"
    yield "from typing import TYPE_CHECKING"
    yield ""
    if checkout is not None:  # before PYTHONPATH: a folder there may have the name of one of the packages
        yield f"sys.path.insert(0, {str(checkout)!r})"
        yield ""
    yield "if TYPE_CHECKING:"
    for name, module in public.items():
        yield f"    from {prefix}{module} import {name} as {name}"
    yield ""
    yield "_MODULES = {"
    for name, module in public.items():
        yield f'    "{name}": "{prefix}{module}",'
    yield "}"
    yield "__all__ = list(_MODULES)"
    yield ""
    yield ""
    yield "def __getattr__(name):"
    yield "    if name not in _MODULES:"
    yield '        raise AttributeError(f"module {__name__!r} has no attribute {name!r}")'
    yield "    return getattr(importlib.import_module(_MODULES[name]), name)"


def _is_ours(module: str) -> bool:
    return module.partition(".")[0] in PACKAGES


def _names_module(text: str, packages: Path) -> bool:
    """Whether `text` is the dotted name of one of our modules, perhaps with a function (`server.tasks.work:run`)."""
    found = _MODULE_NAME.fullmatch(text)
    if found is None or not found[2]:
        return False
    path = packages.joinpath(found[1], *found[2].split(".")[1:])
    return path.is_dir() or path.with_suffix(".py").is_file()
