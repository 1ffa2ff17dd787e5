"""Provides the EGL context and its shader programs, and handles two conventions of OpenGL.

OpenGL counts image rows from the bottom. All code in ``rig.render`` draws image row v to framebuffer row v, because the
projection in ``shaders/camera.glsl`` maps v = 0 to y = -1. OpenGL returns the lowest row first, so that a read image
has row 0 at the top. Anticlockwise triangles become clockwise by this projection, so the context treats clockwise
triangles as front faces.

OpenGL has pixel centres at half-integer window coordinates, and this project at integers, so the shader adds 1/2.
"""

import contextlib
import os
import threading
from collections.abc import Iterator
from pathlib import Path
from typing import Protocol, TypeVar, runtime_checkable

import moderngl

from rig.errors import EigenheadError
from rig.messages.message import Message, compose

SHADERS = Path(__file__).with_name("shaders")
CLIP_PLANES = range(0x3000, 0x3006)  # GL_CLIP_DISTANCE0 and on, as many as shaders/camera.glsl writes


@runtime_checkable
class Releasable(Protocol):
    """Declares the method of a GPU resource that frees it."""

    def release(self) -> None:
        """Frees the resource."""
        ...


Resource = TypeVar("Resource", bound=Releasable)


class EglUnavailable(EigenheadError):
    """Reports that no OpenGL context can be created on this machine."""

    def __init__(self, reason: str) -> None:
        super().__init__(compose("no-opengl", reason=reason))


class WrongThread(EigenheadError):
    """Reports the use of a renderer outside the thread or process that created it, or after it was closed."""

    def __init__(self, why: Message) -> None:
        super().__init__(compose("renderer-of-other-thread", why=why))


class Owned(contextlib.ExitStack):
    """Frees all registered GPU resources, in reverse order, at the end of a ``with`` block, because moderngl does not
    free resources automatically."""

    def __call__(self, resource: Resource) -> Resource:
        """Registers a resource to be freed at the end of the ``with`` block, and returns it."""
        self.callback(resource.release)
        return resource


class GlContext:
    """Holds the moderngl context of one thread, and its compiled shader programs."""

    def __init__(self) -> None:
        try:
            self.gl: moderngl.Context = moderngl.create_context(standalone=True, require=330, backend="egl")  # type: ignore[arg-type]
        except Exception as error:  # moderngl and glcontext raise bare Exceptions of several kinds
            raise EglUnavailable(str(error).splitlines()[0] if str(error) else type(error).__name__) from error
        self.gl.front_face = "cw"  # the row flip, see above
        with self.gl:
            self._info = dict(self.gl.info)  # moderngl keeps what it reads first, and reads nonsense while not current
        self._owner = (os.getpid(), threading.get_ident())
        self._programs: dict[tuple[str, ...], moderngl.Program] = {}
        self._closed = False
        with self.gl:
            self._rest = self.gl.simple_framebuffer((1, 1))

    @contextlib.contextmanager
    def current(self) -> Iterator[moderngl.Context]:
        """Makes the context current during a ``with`` block. Raises WrongThread."""
        if self._closed:
            raise WrongThread(compose("renderer-closed"))
        if (os.getpid(), threading.get_ident()) != self._owner:
            raise WrongThread(compose("renderer-elsewhere"))
        with self.gl:
            yield self.gl

    @contextlib.contextmanager
    def drawing(
        self, target: moderngl.Framebuffer, *, clip: bool = True, cull: bool = False, depth: bool = False
    ) -> Iterator[None]:
        """Makes ``target`` the target of all drawing in a ``with`` block. ``clip`` limits drawing to tiles and to
        points behind the near planes, ``cull`` omits back faces, and ``depth`` adds a depth test."""
        planes = CLIP_PLANES if clip else ()
        for plane in planes:
            self.gl.enable_direct(plane)
        self.gl.enable_only((moderngl.CULL_FACE if cull else 0) | (moderngl.DEPTH_TEST if depth else 0))
        target.use()
        try:
            yield
        finally:
            for plane in planes:
                self.gl.disable_direct(plane)
            self._rest.use()  # moderngl keeps binding the last target, and fails once that is released

    def program(self, vertex: str, fragment: str, geometry: str | None = None) -> moderngl.Program:
        """Returns the shader program from files in ``shaders/``. Each shader program is compiled once."""
        key = (vertex, fragment, geometry or "")
        if key not in self._programs:
            self._programs[key] = self.gl.program(
                vertex_shader=shader_source(vertex),
                fragment_shader=shader_source(fragment),
                geometry_shader=shader_source(geometry) if geometry else None,
            )
        return self._programs[key]

    @property
    def largest_texture(self) -> int:
        """Returns the largest width and height (px) of a texture."""
        return int(self._info["GL_MAX_TEXTURE_SIZE"])

    @property
    def most_samples(self) -> int:
        """Returns the largest number of samples for each pixel."""
        return int(self.gl.max_samples)

    @property
    def description(self) -> str:
        """Returns OpenGL's renderer and version, for example ``llvmpipe (LLVM 15.0.6, 256 bits), 4.5 (Core Profile)
        Mesa 22.3.6``."""
        return f"{self._info['GL_RENDERER']}, {self._info['GL_VERSION']}"

    def close(self) -> None:
        """Frees the programs and the context. The call may be repeated. Raises WrongThread."""
        if not self._closed:
            with self.current():
                for program in self._programs.values():
                    program.release()
            self._closed = True
            self.gl.release()


def shader_source(name: str, folder: Path = SHADERS) -> str:
    """Returns the text of a file in ``folder``, with each line ``#include FILE`` replaced by that file's text."""
    lines = (folder / name).read_text(encoding="utf-8").splitlines()
    return "\n".join(shader_source(line.split()[1], folder) if line.startswith("#include") else line for line in lines)
