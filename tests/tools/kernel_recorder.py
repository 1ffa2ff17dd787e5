"""Which compiled loops jobs call, and with which types.

python -m tests.tools.kernel_recorder pipeline/compute/kernels.txt CAPTURE... writes the list from jobs on captures:
first without the dense stage, then as by default.
"""

import sys
import tempfile
from collections.abc import Iterator, Mapping
from contextlib import contextmanager
from pathlib import Path
from typing import Any

from numba import types

from pipeline.compute.kernel_list import PACKAGE, Kernel, type_from_text
from rig.jit import KeptFunction


def text_from_type(kind: Any) -> str:
    """Returns the list's notation of a Numba type. Raises ValueError if it has none."""
    if isinstance(kind, types.Array):
        text = f"{kind.dtype}[{kind.ndim}{kind.layout}]" + "r" * (not kind.mutable)
    elif isinstance(kind, types.NamedTuple | types.NamedUniTuple):
        module = kind.instance_class.__module__.removeprefix(PACKAGE + ".")
        inside = ";".join(text_from_type(each) for each in kind.types)
        text = f"{module}:{kind.instance_class.__name__}{{{inside}}}"
    elif isinstance(kind, types.UniTuple):
        text = f"{kind.count}*{kind.dtype}"
    else:
        text = str(kind)
    if type_from_text(text) != kind:
        raise ValueError(f"the list of kernels has no notation for {kind!r}")
    return text


@contextmanager
def recorded() -> Iterator[set[Kernel]]:
    """The kernels that Python calls for the first time inside the block; not the loops that those call themselves."""
    found: set[Kernel] = set()
    load, save = KeptFunction.load_overload, KeptFunction.save_overload
    compiling = 0  # a loop that is being compiled asks for those that it calls

    def load_recorded(kept: KeptFunction, signature: tuple, target_context: object) -> object:
        nonlocal compiling
        if not compiling:
            function = kept._dispatcher.py_func
            place = f"{function.__module__.removeprefix('pipeline.')}:{function.__name__}"
            found.add(Kernel(place, tuple(text_from_type(kind) for kind in signature)))
        loaded = load(kept, signature, target_context)
        compiling += loaded is None
        return loaded

    def save_recorded(kept: KeptFunction, signature: tuple, result: object) -> None:
        nonlocal compiling
        compiling -= 1
        save(kept, signature, result)

    KeptFunction.load_overload, KeptFunction.save_overload = load_recorded, save_recorded  # type: ignore[method-assign]
    try:
        yield found
    finally:
        KeptFunction.load_overload, KeptFunction.save_overload = load, save


PLAIN = {"detail": "photo", "outputs": {"surface": "head"}}


def kernels_of(captures: list[Path], settings: Mapping[str, object]) -> set[Kernel]:
    """Of jobs on capture folders, those that no earlier job of this process called."""
    from server.cli.reconstruct_local import reconstruct_locally

    with recorded() as found, tempfile.TemporaryDirectory() as scratch:
        for capture in captures:
            out = Path(scratch) / capture.name
            reconstruct_locally(capture, out, model=None, settings=settings, report=lambda stage, share: None)
    return found


if __name__ == "__main__":
    target, *captures = map(Path, sys.argv[1:])
    target.write_text("")  # a job begins by compiling what its list has, and loops may take other arguments now
    parts = [sorted(kernel.line for kernel in kernels_of(captures, settings)) for settings in (PLAIN, {})]
    target.write_text("\n\n".join(map("\n".join, parts)) + "\n", encoding="utf-8")
