"""Which compiled loops jobs call, and with which types.

python -m tests.tools.kernel_recorder pipeline/compute/kernels.txt CAPTURE... writes the list from jobs on captures:
first without the dense stage, then as by default.
"""

import sys
import tempfile
from collections.abc import Iterator, Mapping
from contextlib import contextmanager
from pathlib import Path

from pipeline.compute.kernel_list import Kernel, text_from_type
from rig.jit import KeptFunction


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
