"""Every private interface of a library that the product uses stands in one table; what is relied on is held by a test.

A library may change these without a word. Then a test here, or the one that the table names, fails by itself."""

import ast
import inspect
import io
import re
import tarfile
import zipfile
from collections.abc import Iterator
from pathlib import Path

import pytest
from nicegui.elements import scene
from numba.core import caching
from numba.core.compiler import CompileResult

from rig.jit import KeptFunction

ROOT = Path(__file__).resolve().parents[1]
FLOORS = ("rig", "pipeline", "calibration", "server")
DOCUMENTED = re.compile(r"os\._exit|\w+\._(asdict|replace|fields)")  # public, for all their underscore
USES = {
    ("rig/formats/captures/archive.py", "zipfile._EndRecData"),
    ("rig/formats/captures/archive.py", "super()._proc_member"),
    ("rig/jit.py", "dispatcher._cache"),  # used in tests/rig/test_jit.py
    ("rig/jit.py", "result._reduce"),
    ("rig/jit.py", "CompileResult._rebuild"),
    ("server/services/failures.py", "dbos._serialization: _serialization"),  # tests/server/services/test_failures.py
}


def private_uses(source: str) -> Iterator[str]:
    """Finds what a module takes from others under a name that begins with one underscore."""
    for node in ast.walk(ast.parse(source)):
        if isinstance(node, ast.Attribute) and re.match(r"_[^_]", node.attr):
            holder = ast.unparse(node.value)
            if holder not in ("self", "cls"):
                yield f"{holder}.{node.attr}"
        elif isinstance(node, ast.ImportFrom):
            names = [*(node.module or "").split("."), *(alias.name for alias in node.names)]
            yield from (f"{node.module}: {name}" for name in names if re.match(r"_[^_]", name))


def own_names(source: str) -> set[str]:
    """Lists the private functions, classes and attributes that a module defines."""
    return {"".join(found) for found in re.findall(r"(?:def|class) (_\w+)|self\.(_\w+)(?:: [^=]+)? = ", source)}


def test_every_private_interface_stands_in_the_table() -> None:
    sources = {
        path.relative_to(ROOT).as_posix(): path.read_text() for floor in FLOORS for path in (ROOT / floor).rglob("*.py")
    }
    found = {
        (name, use)
        for name, source in sources.items()
        for use in private_uses(source)
        if use.rpartition(".")[2] not in own_names(source) and not DOCUMENTED.fullmatch(use)
    }
    assert found == {use for use in USES if not use[1].startswith("super()")}
    for name, use in USES:  # what a subclass replaces is defined in its own module, too
        assert use in private_uses(sources[name])


@pytest.mark.parametrize(
    ("source", "use"),
    [
        ("from numba import _dispatcher", "numba: _dispatcher"),
        ("from dbos._serialization import Default", "dbos._serialization: _serialization"),
        ("zipfile._get_decompressor(8)", "zipfile._get_decompressor"),
    ],
)
def test_a_planted_use_is_found(source: str, use: str) -> None:
    assert [*private_uses(source)] == [use]


def test_zipfile_says_how_long_the_list_of_members_is_without_reading_it() -> None:
    plain = io.BytesIO()
    with zipfile.ZipFile(plain, "w") as archive:
        archive.writestr("a.png", b"1")
        archive.comment = b"twelve bytes"
    end = zipfile._EndRecData(plain)  # type: ignore[attr-defined]
    assert end[5] == 46 + len("a.png")  # APPNOTE.TXT 4.3.12: a header of the central directory and its name
    assert zipfile._EndRecData(io.BytesIO(b"no archive")) is None  # type: ignore[attr-defined]


def test_tarfile_hands_every_member_to_the_class_that_it_is_given() -> None:
    seen = []

    class Watched(tarfile.TarInfo):
        def _proc_member(self, archive: tarfile.TarFile) -> tarfile.TarInfo:
            seen.append((self.name, self.type))
            return super()._proc_member(archive)  # type: ignore[misc]

    packed = io.BytesIO()
    with tarfile.open(fileobj=packed, mode="w", format=tarfile.GNU_FORMAT) as archive:
        archive.addfile(tarfile.TarInfo("n" * 120))
    packed.seek(0)
    with tarfile.open(fileobj=packed, tarinfo=Watched) as archive:
        assert archive.getnames() == ["n" * 120]
    # The header of the long name comes first, before its content is read into memory.
    assert [kind for _, kind in seen] == [tarfile.GNUTYPE_LONGNAME, tarfile.REGTYPE]


def test_numba_asks_of_a_cache_what_ours_has() -> None:
    methods = {name for name in vars(caching._Cache) if not name.startswith("_")}
    assert {"cache_path", "load_overload", "save_overload"} <= methods
    missing = {name for name in methods if not hasattr(KeptFunction, name)}
    assert missing == {"enable", "disable"}  # Numba calls neither
    for name in ("load_overload", "save_overload"):
        ours, theirs = (inspect.signature(getattr(kind, name)) for kind in (KeptFunction, caching._Cache))
        assert len(ours.parameters) == len(theirs.parameters)


def test_numba_rebuilds_a_compiled_function_from_what_it_reduces_to() -> None:
    assert [*inspect.signature(CompileResult._reduce).parameters] == ["self"]
    assert next(iter(inspect.signature(CompileResult._rebuild).parameters)) == "target_context"


def test_nicegui_has_its_bundle_of_three_js_beside_the_scene() -> None:
    assert (Path(scene.__file__).with_name("dist") / "index.js").is_file()
