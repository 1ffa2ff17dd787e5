"""The one EGL context, its programs, and OpenGL's two conventions that differ from ours.

Row flip. OpenGL counts rows from below. Everything in ``rig.render`` draws image row v into framebuffer row v (the
projection in ``shaders/camera.glsl`` maps v = 0 to y = -1), so that what is read back, lowest row first, has our row 0
on top, and no image is ever turned over. The price is paid here alone: counter-clockwise triangles arrive clockwise,
so the context counts clockwise as front.

Pixel centre. A fragment's centre is at half-integer window coordinates; our pixel (0, 0) is a centre, so the shader
adds 1/2 on the way in.
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
    def release(self) -> None: ...


Resource = TypeVar("Resource", bound=Releasable)


class EglUnavailable(EigenheadError):
    """Reports that no OpenGL context could be made on this machine."""

    def __init__(self, reason: str) -> None:
        super().__init__(compose("no-opengl", reason=reason))


class WrongThread(EigenheadError):
    """Reports that a renderer was used outside the thread or process that made it, or after it was closed."""

    def __init__(self, why: Message) -> None:
        super().__init__(compose("renderer-of-other-thread", why=why))


class Owned(contextlib.ExitStack):
    """Releases what is passed through a call of this, in reverse order: moderngl frees nothing by itself."""

    def __call__(self, resource: Resource) -> Resource:
        self.callback(resource.release)
        return resource


class GlContext:
    """Holds a moderngl context of this thread, and its compiled programs by the names of their shader files."""

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
        """Makes the context current for a while. Raises WrongThread."""
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
        """Draws into ``target``: clipped at tiles and near planes, without back faces, with a depth test, as wanted."""
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
        """Returns the program of these files of ``shaders/``, compiled once."""
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
        return int(self._info["GL_MAX_TEXTURE_SIZE"])

    @property
    def most_samples(self) -> int:
        return int(self.gl.max_samples)

    @property
    def description(self) -> str:
        """Returns renderer and version, for reports: ``llvmpipe (LLVM 15.0.6, 256 bits), 4.5 (Core Profile) Mesa
        22.3.6``."""
        return f"{self._info['GL_RENDERER']}, {self._info['GL_VERSION']}"

    def close(self) -> None:
        if not self._closed:
            with self.current():
                for program in self._programs.values():
                    program.release()
            self._closed = True
            self.gl.release()


def shader_source(name: str, folder: Path = SHADERS) -> str:
    """Returns the text of a file of ``folder``; a line ``#include FILE`` stands for that file."""
    lines = (folder / name).read_text(encoding="utf-8").splitlines()
    return "\n".join(shader_source(line.split()[1], folder) if line.startswith("#include") else line for line in lines)
