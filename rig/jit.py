"""Compiles Python functions with Numba, and caches the machine code under a hash of its sources for later processes.

The function ``njit`` of this module replaces the cache of Numba's ``njit``. Numba's cache is an index for each function
beside the source file, and starts empty in every checkout. Numba's cache ignores changes to a called function in
another file. It loses or mixes entries when two processes write one index, and a full disk or a damaged file makes a
job fail. In this module's cache, each compiled function is one file in ``cache_folder()/kernels``, written atomically.
The file's name is the SHA-256 of all that the machine code depends on: byte code and constants of the function and its
callees, argument types, the processor, and the versions of Python, Numba and LLVM.

Code is compiled for the instructions that all x86-64 processors since 2013 have (``PORTABLE_CPU``). Thus a container, a
wheel or a CI's cache can carry machine code to other machines. Code for one specific processor was not faster: with
AVX-512 a job took as many CPU seconds.

Numba has no public interface for another cache. This module uses Numba's internal ``Dispatcher._cache`` (an object with
``load_overload`` and ``save_overload``), ``CompileResult._reduce`` and ``_rebuild``, ``serialize.dumps``, the option
``_nrt`` and the flag ``noalias``.
"""

import hashlib
import logging
import pickle
import sys
from collections.abc import Callable, Iterator
from functools import cache
from pathlib import Path
from types import CodeType, FunctionType, ModuleType
from typing import Any

import llvmlite
import llvmlite.binding
import numba
import numpy as np
from numba.core import config, serialize
from numba.core.compiler import CompileResult
from numba.core.dispatcher import Dispatcher
from numba.core.options import TargetOptions
from numba.core.registry import cpu_target
from numba.core.runtime.nrt import rtsys

from rig.files import cache_folder, write_atomically

CARRIED = Path(__file__).with_name("compiled_loops")  # beside the code, where a wheel was built with them
DIGEST_BYTES = 32
PORTABLE_CPU = "x86-64-v3"
PORTABLE_FEATURES = ("avx2", "bmi", "bmi2", "f16c", "fma", "lzcnt", "movbe")  # what that level adds
# Eight pixels are fetched by one instruction where LLVM would otherwise leave the loop unvectorised: the dense stage's
# sweep takes 0.80, planes 0.84 and slides 0.88 of the processor seconds. Every processor of that level has it.
PORTABLE_TUNING = "+fast-gather"

log = logging.getLogger("eigenhead")


def _choose_processor() -> None:
    """Makes Numba compile for ``PORTABLE_CPU``. Does nothing if NUMBA_CPU_NAME is set or this processor lacks a feature
    of ``PORTABLE_CPU``."""
    options: Any = config
    try:
        host: dict[str, bool] = dict(llvmlite.binding.get_host_cpu_features())
    except RuntimeError:  # LLVM does not know this processor
        return
    if options.CPU_NAME is None and all(host.get(feature) for feature in PORTABLE_FEATURES):
        options.CPU_NAME, options.CPU_FEATURES = PORTABLE_CPU, PORTABLE_TUNING


_choose_processor()
_target_options: Any = cpu_target.options
_target_options.noalias = TargetOptions.Mapping("noalias")  # a flag of Numba's that no option sets


def njit(
    *, cache: bool = True, allocates: bool = True, overlaps: bool = True, **options: Any
) -> Callable[[Callable[..., Any]], Any]:
    """Compiles a function as ``numba.njit`` does, and stores the machine code in ``cache_folder()``.

    Args:
        cache: whether to keep it.
        allocates: whether the function, or one that it calls, creates arrays. If False, Numba's reference counting is
            left out. With it every new name of an array, a row or a field costs an atomic instruction, for which cores
            wait on each other: most of the time of the dense stage's sweep.
        overlaps: whether arguments may share memory. If False, LLVM vectorises also a loop that writes to one array
            what it reads from another at computed places.
        options: passed on to ``numba.njit``.
    """

    def compiled(function: Callable[..., Any]) -> Any:
        chosen: dict[str, Any] = {"no_cfunc_wrapper": True, **options}  # nothing in C calls them: 8 % of compiling
        if not allocates:
            chosen["_nrt"] = False
        if not overlaps:
            chosen["noalias"] = True
        dispatcher = numba.njit(**chosen)(function)
        if cache and isinstance(dispatcher, Dispatcher):  # with NUMBA_DISABLE_JIT it is the function itself
            dispatcher._cache = KeptFunction(dispatcher)  # type: ignore[assignment]
        return dispatcher

    return compiled


class KeptFunction:
    """Reads and writes the machine code of one function on disk. Numba uses the object as its cache."""

    def __init__(self, dispatcher: Dispatcher) -> None:
        self._dispatcher = dispatcher
        self._digest = ""

    @property
    def cache_path(self) -> str:
        """Returns the folder in which new machine code is stored."""
        return str(cache_folder() / "kernels")

    def file(self, signature: Any) -> Path:
        """Returns the path of the file, existing or not, for the machine code of the argument types ``signature``."""
        if not self._digest:  # late: a function may call one that its module defines further down
            self._digest = function_digest(self._dispatcher)
        key = f"{self._digest} {signature!r} {machine()}"
        function = self._dispatcher.py_func
        name = f"{function.__module__.rpartition('.')[2]}.{function.__name__}"
        return Path(self.cache_path) / f"{name}-{hashlib.sha256(key.encode()).hexdigest()}"

    def is_kept(self, signature: Any) -> bool:
        """Returns whether machine code for the argument types ``signature`` is stored."""
        file = self.file(signature)
        try:
            return (CARRIED / file.name).is_file() or file.is_file()
        except OSError:  # a folder that cannot be looked into
            return False

    def load_overload(self, signature: Any, target_context: Any) -> Any:
        """Returns the compiled function from its file, or None if the file is missing or damaged."""
        rtsys.initialize(target_context)  # not its refresh(), which loads what only a compiler needs: 0.4 s
        file = self.file(signature)
        for path in (CARRIED / file.name, file):
            try:
                data = path.read_bytes()
            except OSError:
                continue
            if hashlib.sha256(data[DIGEST_BYTES:]).digest() == data[:DIGEST_BYTES]:
                return CompileResult._rebuild(target_context, *pickle.loads(data[DIGEST_BYTES:]))
        return None

    def save_overload(self, signature: Any, result: Any) -> None:
        """Writes a compiled function to its file. Logs the first failure of a process and continues."""
        if any(not lifted.can_cache for lifted in result.lifted) or result.library.has_dynamic_globals:
            return
        data = serialize.dumps(result._reduce())
        try:
            write_atomically(self.file(signature), hashlib.sha256(data).digest() + data)
        except OSError as error:
            say_not_kept(error)

    def flush(self) -> None:
        """Does nothing, but Numba requires this method. Files of older code need no removal, because file names contain
        a digest of the code."""


@cache
def _warned() -> set[str]:
    return set()


def say_not_kept(error: OSError) -> None:
    """Logs, once in each process, why the cache folder cannot be written."""
    folder = str(cache_folder())
    if folder not in _warned():
        _warned().add(folder)
        log.warning(
            "compiled loops and arrays of head models are not kept in %s (%s): what is missing there is made anew each "
            "time; EIGENHEAD_CACHE names another folder",
            folder,
            error.strerror or error,
        )


@cache
def machine() -> str:
    """Returns a text with the versions of Python, Numba and LLVM, compiler options and processor features."""
    options: Any = config
    target: Any = cpu_target.target_context
    versions = (numba.__version__, llvmlite.__version__, sys.implementation.cache_tag)
    return repr((versions, options.OPT, options.BOUNDSCHECK, target.codegen().magic_tuple()))


def function_digest(dispatcher: Dispatcher) -> str:
    """Returns the SHA-256 digest of all sources that the compiled function depends on."""
    digest = hashlib.sha256()
    for part in _function_parts(dispatcher, set()):
        digest.update(part)
        digest.update(b"\0")
    return digest.hexdigest()


def code_size(dispatcher: Dispatcher) -> int:
    """Returns the size (bytes) of all code that the function depends on, roughly proportional to its compile time."""
    return sum(map(len, _function_parts(dispatcher, set())))


def _function_parts(dispatcher: Dispatcher, visited: set[int]) -> Iterator[bytes]:
    function = dispatcher.py_func
    yield f"{function.__module__}.{function.__qualname__} {sorted(dispatcher.targetoptions.items())!r}".encode()
    if id(dispatcher) in visited:
        return
    visited.add(id(dispatcher))
    yield repr(function.__defaults__).encode()
    names = list(_code_names(function.__code__))
    yield from _code_parts(function.__code__)
    for cell in function.__closure__ or ():
        yield from _value_parts(cell.cell_contents, names, visited)
    for name in names:
        if name in function.__globals__:
            yield name.encode()
            yield from _value_parts(function.__globals__[name], names, visited)


def _code_names(code: CodeType) -> Iterator[str]:
    yield from code.co_names
    for constant in code.co_consts:
        if isinstance(constant, CodeType):
            yield from _code_names(constant)


def _code_parts(code: CodeType) -> Iterator[bytes]:
    yield code.co_code
    yield repr((code.co_names, code.co_varnames, code.co_argcount)).encode()
    for constant in code.co_consts:
        if isinstance(constant, CodeType):
            yield from _code_parts(constant)
        else:
            yield repr(sorted(constant, key=repr) if isinstance(constant, frozenset) else constant).encode()


def _value_parts(value: Any, names: list[str], visited: set[int]) -> Iterator[bytes]:
    """Yields a global value, or the code and the values of a function, that a compiled function uses, as bytes."""
    if isinstance(value, Dispatcher):
        yield from _function_parts(value, visited)
    elif isinstance(value, ModuleType):
        yield value.__name__.encode()
        if id(value) in visited:
            return
        visited.add(id(value))
        if value.__name__.partition(".")[0] == __name__.partition(".")[0]:
            for name in names:
                yield from _value_parts(getattr(value, name, None), names, visited)
    elif isinstance(value, np.ndarray):
        yield f"{value.dtype} {value.shape}".encode() + value.tobytes()
    elif isinstance(value, FunctionType | type):
        yield f"{value.__module__}.{value.__qualname__}".encode()
    else:
        yield repr(value).encode()
