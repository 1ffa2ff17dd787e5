"""The list of loops that set-up compiles: it can be read, names what there is, and lacks nothing."""

import subprocess
import sys
from pathlib import Path

import pytest
from numba import types

from pipeline.compute.kernel_list import LIST, Kernel, by_module, listed_kernels, type_from_text
from pipeline.fusion.vote_kernels import Pixels
from server.processes import python_command, python_environment
from tests.tools.kernel_recorder import text_from_type


def test_every_line_names_a_loop_and_its_types() -> None:
    plain, added = (part.splitlines() for part in LIST.read_text(encoding="utf-8").split("\n\n"))
    assert plain == sorted(set(plain))
    assert added == sorted(set(added) - set(plain))
    kernels = listed_kernels()
    assert [kernel.line for kernel in kernels] == plain + added
    assert [kernel.line for kernel in listed_kernels(dense=False)] == plain
    for kernel in kernels:
        dispatcher = kernel.dispatcher()
        assert dispatcher is not None
        assert dispatcher.py_func.__code__.co_argcount == len(kernel.arguments)
        assert tuple(map(text_from_type, kernel.signature())) == kernel.arguments
    assert sum(map(len, by_module(kernels))) == len(kernels)


@pytest.mark.parametrize(
    ("text", "kind"),
    [
        ("int64", types.int64),
        ("bool", types.boolean),
        ("4*float64", types.UniTuple(types.float64, 4)),
        ("float32[2C]", types.Array(types.float32, 2, "C")),
        (
            "fusion.vote_kernels:Pixels{" + ";".join(["float32[1C]"] * len(Pixels._fields)) + "}",
            types.NamedUniTuple(types.Array(types.float32, 1, "C"), len(Pixels._fields), Pixels),
        ),
        ("bool[3A]r", types.Array(types.boolean, 3, "A", readonly=True)),
    ],
)
def test_types_have_a_short_notation(text: str, kind: types.Type) -> None:
    assert type_from_text(text) == kind
    assert text_from_type(kind) == text


@pytest.mark.parametrize("kind", [types.unicode_type, types.Array(types.float64, 1, "C", aligned=False), types.none])
def test_a_type_without_notation_is_refused(kind: types.Type) -> None:
    with pytest.raises(ValueError, match=r"no type|no notation"):
        text_from_type(kind)


@pytest.mark.slow
@pytest.mark.gl
def test_a_default_job_calls_no_loop_that_the_list_lacks(tmp_path: Path) -> None:
    def run(command: list[str]) -> None:
        subprocess.run(command, env=python_environment(), check=True, timeout=280)

    run(python_command("cli", "simulate", str(tmp_path / "shot"), "--seed", "1"))
    run([sys.executable, "-m", "tests.tools.kernel_recorder", str(tmp_path / "list"), str(tmp_path / "shot")])
    parts = (tmp_path / "list").read_text(encoding="utf-8").split("\n\n")
    plain, added = ({Kernel.from_line(line) for line in part.splitlines()} for part in parts)
    for called, dense in ((plain, False), (plain | added, True)):
        missing = sorted(kernel.line for kernel in called - set(listed_kernels(dense=dense)))
        assert not missing, (
            "write the list: python -m tests.tools.kernel_recorder pipeline/compute/kernels.txt CAPTURE..."
        )
    assert len(plain) > 15  # that something was recorded at all
    assert len(added) > 10
