"""Runs compute shaders, which are programs that compute with arrays on the GPU.

Compute shaders need OpenGL 4.3 on EGL but no further driver. Without a GPU, Mesa's software renderer runs the same
shaders, but more slowly than compiled loops on the CPU.
"""

import contextlib
import threading
from collections.abc import Iterator, Mapping, Sequence
from pathlib import Path
from typing import Literal

import moderngl
import numpy as np

from rig.errors import EigenheadError
from rig.messages.message import compose
from rig.render.context import Owned, shader_source

DeviceName = Literal["auto", "cpu", "gl"]
SOFTWARE = ("llvmpipe", "softpipe", "swiftshader", "software")  # in the name of a renderer that is no GPU
# NVIDIA writes every loop out otherwise: 6 s of compiling for each process, and no faster.
GLSL = "#version 430 core\n#pragma optionNV(unroll none)"
Uniforms = Mapping[str, float | int | tuple[int, int]]


class ComputeUnavailable(EigenheadError):
    """Reports that no compute shader can run on this machine."""

    def __init__(self, reason: str) -> None:
        super().__init__(compose("no-compute", reason=reason))


class DeviceArray:
    """Holds an array in the memory of a compute device."""

    def __init__(self, buffer: moderngl.Buffer) -> None:
        self.buffer = buffer


class ComputeDevice:
    """Runs compute shaders in a separate OpenGL context. Any thread may call the methods, which run one after another.

    ``with ComputeDevice.create() as device: ...``. Raises ComputeUnavailable if there is no OpenGL 4.3.
    """

    def __init__(self) -> None:
        try:
            self._gl: moderngl.Context = moderngl.create_context(standalone=True, require=430, backend="egl")  # type: ignore[arg-type]
        except Exception as error:  # moderngl and glcontext raise bare Exceptions of several kinds
            raise ComputeUnavailable(str(error).splitlines()[0] if str(error) else type(error).__name__) from error
        self._lock = threading.Lock()
        self._shaders: dict[str, moderngl.ComputeShader] = {}
        with self._gl:
            info = self._gl.info
            self.description = f"{info['GL_RENDERER']}, {info['GL_VERSION']}"
            self.largest_array = int(info["GL_MAX_SHADER_STORAGE_BLOCK_SIZE"])  # bytes

    @classmethod
    def create(cls) -> "ComputeDevice":
        """Creates a device. Raises ComputeUnavailable without OpenGL 4.3."""
        return cls()

    def __enter__(self) -> "ComputeDevice":
        return self

    def __exit__(self, *_: object) -> None:
        self.close()

    def close(self) -> None:
        """Frees the OpenGL context and its resources."""
        with self._lock:
            self._gl.release()

    @contextlib.contextmanager
    def uploaded(self, *arrays: np.ndarray) -> Iterator[tuple[DeviceArray, ...]]:
        """Copies arrays to the device and yields the copies, which are freed at the end of the ``with`` block."""
        with self._current():
            held = tuple(DeviceArray(self._gl.buffer(np.ascontiguousarray(array))) for array in arrays)
        try:
            yield held
        finally:
            with self._current():
                for buffer in held:
                    buffer.buffer.release()

    def run(
        self,
        shader: Path,
        groups: tuple[int, int],
        arrays: Sequence[DeviceArray | np.ndarray],
        written: Sequence[int],
        *,
        constants: Mapping[str, int],
        uniforms: Uniforms,
    ) -> None:
        """Runs a compute shader on the device.

        Args:
            shader: file of its source; ``#include`` reads files beside it.
            groups: numbers of groups across and down.
            arrays: bound to the shader's bindings 0, 1, 2 and so on; a NumPy array is copied to the device for this
                run.
            written: bindings of those NumPy arrays (contiguous) that receive what the shader wrote.
            constants: defined for the preprocessor; each combination is compiled once.
            uniforms: values by name.
        """
        with self._current(), Owned() as owned:
            program = self._program(shader, constants)
            for name, value in uniforms.items():
                program[name] = value
            buffers = []
            for binding, array in enumerate(arrays):
                buffers.append(array.buffer if isinstance(array, DeviceArray) else owned(self._gl.buffer(array)))
                buffers[-1].bind_to_storage_buffer(binding)
            program.run(*groups)
            self._gl.memory_barrier()
            for binding in written:
                buffers[binding].read_into(arrays[binding])

    def _program(self, shader: Path, constants: Mapping[str, int]) -> moderngl.ComputeShader:
        defines = [f"#define {name} {value}" for name, value in sorted(constants.items())]
        source = "\n".join([GLSL, *defines, shader_source(shader.name, shader.parent)])
        if source not in self._shaders:
            self._shaders[source] = self._gl.compute_shader(source)
        return self._shaders[source]

    @contextlib.contextmanager
    def _current(self) -> Iterator[None]:
        with self._lock, self._gl:
            yield


def open_device(name: DeviceName, renderer: str) -> ComputeDevice | None:
    """Opens the device for computations. Returns None if the CPU should compute.

    Args:
        name: ``gl`` takes any OpenGL, ``auto`` a GPU if there is one.
        renderer: description of the OpenGL that draws.

    Raises:
        ComputeUnavailable: ``gl`` is requested and not available.
    """
    if name == "cpu" or (name == "auto" and is_software(renderer)):
        return None
    try:
        return ComputeDevice.create()
    except ComputeUnavailable:
        if name == "gl":
            raise
        return None


def is_software(renderer: str) -> bool:
    """Returns whether a description of OpenGL's renderer names a software renderer."""
    return any(word in renderer.lower() for word in SOFTWARE)
