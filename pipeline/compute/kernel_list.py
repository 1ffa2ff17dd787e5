"""Lists the compiled loops that a default job calls, with their argument types, so that they can be compiled in
advance.

``kernels.txt`` in this folder has a line for each: module and function, then the types of the arguments. First come
those of a job without dense matching (``--detail photo --surface head``); after an empty line come those that dense
matching adds. ``float32[2C]`` is a two-dimensional array in C order (A: any strides), followed by ``r`` if it is
read-only; ``4*float64`` is a tuple, ``stereo.matching_kernels:Sight{float64[2C];int64}`` a named one. The list is
recorded, not written by hand: ``python -m tests.tools.kernel_recorder`` runs jobs and writes it. A test runs a job and
fails if the list lacks a loop.

Signatures in the decorators, the alternative to this list, would be needed in 105 places, mostly for loops that only
other loops call, and a wrong type in a signature would break a job. Running the whole pipeline during set-up instead
would take as long as a job in one process."""

import importlib
import re
from collections.abc import Iterable, Iterator
from dataclasses import dataclass
from pathlib import Path
from types import ModuleType

from numba import types
from numba.core.dispatcher import Dispatcher

from rig.jit import KeptFunction, code_size

LIST = Path(__file__).with_name("kernels.txt")
PACKAGE = (__package__ or "").rpartition(".")[0] or "pipeline"  # "eigenhead.pipeline" in the wheel
_ARRAY = re.compile(r"(\w+)\[(\d)([CFA])\](r?)")
_TUPLE = re.compile(r"(\d+)\*(\w+)")
_NAMED = re.compile(r"([\w.]+):(\w+)\{(.*)\}")


@dataclass(frozen=True, slots=True)
class Kernel:
    """Holds the name of one compiled function and the types of its arguments."""

    place: str  # "contour_fit.rim_kernels:see", relative to this package; those of ``rig`` have their room before them
    arguments: tuple[str, ...]

    @classmethod
    def from_line(cls, line: str) -> "Kernel":
        """Parses a line of the list: a kernel's module and name, then its argument types, separated by spaces."""
        place, *arguments = line.split()
        return cls(place, tuple(arguments))

    @property
    def line(self) -> str:
        """Returns the kernel as a line of the list."""
        return " ".join((self.place, *self.arguments))

    @property
    def module(self) -> str:
        """Returns the dotted name of the kernel's module within the package ``pipeline``."""
        return self.place.partition(":")[0]

    def dispatcher(self) -> Dispatcher | None:
        """Returns the compiled function's dispatcher, or None if loops are not compiled (NUMBA_DISABLE_JIT)."""
        module, _, name = self.place.partition(":")
        function = getattr(import_kernels(module), name)
        return function if isinstance(function, Dispatcher) else None

    def signature(self) -> tuple[types.Type, ...]:
        """Returns the argument types as Numba's type objects. Raises ValueError for an unknown notation of a type."""
        return tuple(type_from_text(text) for text in self.arguments)

    def is_kept(self) -> bool:
        """Returns whether the kernel's machine code is in the wheel or in the cache folder. Returns True if loops are
        not compiled at all (NUMBA_DISABLE_JIT)."""
        dispatcher = self.dispatcher()
        kept = None if dispatcher is None else getattr(dispatcher, "_cache", None)
        return not isinstance(kept, KeptFunction) or kept.is_kept(self.signature())

    def size(self) -> int:
        """Returns the size in bytes of the Python byte code of the kernel and of all functions that it calls. Kernels
        are compiled in order of this size, the largest first; the size is 0 if loops are not compiled."""
        dispatcher = self.dispatcher()
        return 0 if dispatcher is None else code_size(dispatcher)

    def compile(self) -> None:
        """Compiles the kernel for its argument types, or loads it from the cache."""
        dispatcher = self.dispatcher()
        if dispatcher is not None:
            dispatcher.compile(self.signature())


def import_kernels(module: str) -> ModuleType:
    """Imports a module that the list names."""
    package = PACKAGE.removesuffix("pipeline") if module.startswith("rig.") else f"{PACKAGE}."
    return importlib.import_module(package + module)


def listed_kernels(*, dense: bool = True) -> list[Kernel]:
    """Returns all kernels of the list; if ``dense`` is False, without kernels that only dense matching calls."""
    plain, _, added = LIST.read_text(encoding="utf-8").partition("\n\n")
    return [Kernel.from_line(line) for line in (*plain.splitlines(), *(added.splitlines() if dense else ()))]


def by_module(kernels: Iterable[Kernel]) -> Iterator[list[Kernel]]:
    """Yields lists of kernels, one for each module. Kernels of one module call the same inner loops, which two
    processes would otherwise compile twice."""
    groups: dict[str, list[Kernel]] = {}
    for kernel in kernels:
        groups.setdefault(kernel.module, []).append(kernel)
    yield from groups.values()


def type_from_text(text: str) -> types.Type:
    """Returns the Numba type for its notation in the list of kernels. Raises ValueError for an unknown notation."""
    if array := _ARRAY.fullmatch(text):
        dtype, dimensions, layout, readonly = array.groups()
        return types.Array(_scalar(dtype), int(dimensions), layout, readonly=bool(readonly))
    if several := _TUPLE.fullmatch(text):
        return types.UniTuple(_scalar(several[2]), int(several[1]))
    if named := _NAMED.fullmatch(text):
        module, name, inside = named.groups()
        kind = getattr(import_kernels(module), name)
        found = types.BaseTuple.from_types([type_from_text(each) for each in _members(inside)], kind)
        if found is None:
            raise ValueError(f"{text} is no tuple of a kernel's arguments")
        return found
    return _scalar(text)


def _members(text: str) -> Iterator[str]:
    """Yields the parts of a text between semicolons, except semicolons inside braces."""
    depth = start = 0
    for at, sign in enumerate(text):
        depth += (sign == "{") - (sign == "}")
        if sign == ";" and not depth:
            yield text[start:at]
            start = at + 1
    yield text[start:]


def _scalar(name: str) -> types.Type:
    kind = types.boolean if name == "bool" else getattr(types, name, None)
    if not isinstance(kind, types.Number | types.Boolean):
        raise ValueError(f"{name} is no type of a kernel's argument")
    return kind
