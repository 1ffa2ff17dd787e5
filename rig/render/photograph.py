"""Draws the photographs of the simulated studio from the colours and the irradiance of a subject's vertices.

Structure finer than the vertices is a function of the position on the subject, so that all views agree on every pore. A
shader evaluates the fine structure at each pixel (``shaders/grain.glsl``). A weak highlight on skin depends on the
view. Radiance is linear, and a pixel is the mean of several samples.

The software renderer llvmpipe computes both sides of every branch. Shading brows and lips at each pixel would therefore
take three times as long (2.5 us for each pixel).
"""

from collections.abc import Sequence
from dataclasses import dataclass

import moderngl
import numpy as np
from jaxtyping import Float, Int, UInt8

from rig.camera import Camera
from rig.render.context import GlContext, Owned
from rig.render.tile_packing import INSTANCE_FORMAT, INSTANCE_NAMES, box_points, depth_range, instances, pack
from rig.rig import Rig

NOISE_CELLS = 64
VERTEX_ROW = 1024

Vector4 = tuple[float, float, float, float]


@dataclass(frozen=True, slots=True)
class Grain:
    """Describes the fine structure of a surface by noise with two octaves. Holds the octaves' cell sizes (mm) along the
    axes of ``Part.places``, and the weights of the four noise values."""

    coarse_mm: tuple[float, float, float]
    coarse_weights: Vector4
    fine_mm: tuple[float, float, float]
    fine_weights: Vector4
    freckles: float = 0.0
    gloss: float = 0.0


@dataclass(frozen=True, slots=True, eq=False)
class Part:
    """Holds a part of the subject, such as skin or hair, in the world frame (mm).

    ``places`` holds the coordinates (mm) at which the fine structure is evaluated. ``paint`` holds linear albedo and
    the strength of the fine structure. ``irradiance`` is linear RGB; a value of 1 makes white paper white.
    """

    vertices: Float[np.ndarray, "v 3"]
    faces: Int[np.ndarray, "f 3"]
    normals: Float[np.ndarray, "v 3"]
    places: Float[np.ndarray, "v 3"]
    paint: Float[np.ndarray, "v 4"]
    irradiance: Float[np.ndarray, "v 3"]
    grain: Grain
    one_sided: bool = False  # nobody can look at its inside: half the triangles need not be drawn
    oil: Float[np.ndarray, " v"] | None = None  # strength of sharp highlights; None: none


@dataclass(frozen=True, slots=True, eq=False)
class Gallery:
    """Holds the noise volume for the fine structure, and two lamps that cause highlights (world frame, linear RGB)."""

    noise: UInt8[np.ndarray, "64 64 64 4"]
    lamps: Float[np.ndarray, "2 3"]
    lamp_colours: Float[np.ndarray, "2 3"]


def draw_photographs(
    context: GlContext, rig: Rig, parts: Sequence[Part], gallery: Gallery, samples: int
) -> dict[str, Float[np.ndarray, "_ _ 4"]]:
    """Draws the parts in each camera. Returns linear RGB multiplied by coverage, and coverage (float32). Cameras are
    drawn one at a time, because the samples of one camera take 25 MB."""
    origin = rig.centre_world()
    box = np.concatenate([box_points(part.vertices) for part in parts])
    pictures = {}
    with context.current() as gl, Owned() as owned:
        owned(_noise_texture(gl, gallery)).use(0)
        program = context.program("studio.vert", "studio.frag")
        pieces = [(part, _upload(gl, owned, part, origin)) for part in parts]
        for camera in rig:
            pictures[camera.name] = _draw(
                context, program, camera, pieces, gallery, origin=origin, box=box, samples=samples
            )
    return pictures


def draw_vertex_radiance(context: GlContext, part: Part, gallery: Gallery) -> Float[np.ndarray, "v 3"]:
    """Returns the linear RGB (float32) with which ``draw_photographs`` draws each vertex, without highlights."""
    count = len(part.vertices)
    size = (VERTEX_ROW, -(-count // VERTEX_ROW))
    with context.current() as gl, Owned() as owned:
        owned(_noise_texture(gl, gallery)).use(0)
        program = context.program("vertices.vert", "vertices.frag")
        program["target_size"] = (float(size[0]), float(size[1]))
        _set_uniforms(program, part.grain, gallery)
        table = np.ascontiguousarray(np.concatenate([part.places, part.paint, part.irradiance], axis=1), np.float32)
        content = (owned(gl.buffer(table.tobytes())), "3f 4f 3f", "place", "paint", "irradiance")
        draw = owned(gl.vertex_array(program, [content]))
        target = owned(gl.framebuffer([owned(gl.texture(size, 4, dtype="f4"))]))
        with context.drawing(target, clip=False):
            draw.render(moderngl.POINTS, vertices=count)
        raw = target.read(components=4, dtype="f4")
    return np.frombuffer(raw, np.float32).reshape(-1, 4)[:count, :3].copy()


def _noise_texture(gl: moderngl.Context, gallery: Gallery) -> moderngl.Texture3D:
    texture = gl.texture3d((NOISE_CELLS, NOISE_CELLS, NOISE_CELLS), 4, gallery.noise.tobytes())
    texture.filter = (moderngl.LINEAR, moderngl.LINEAR)
    return texture


def _upload(gl: moderngl.Context, owned: Owned, part: Part, origin: Float[np.ndarray, " 3"]) -> list[moderngl.Buffer]:
    oil = np.zeros((len(part.vertices), 1)) if part.oil is None else part.oil[:, None]
    columns = (part.vertices - origin, part.normals, part.places, part.paint, part.irradiance, oil)
    table = np.ascontiguousarray(np.concatenate(columns, axis=1), np.float32)
    indices = np.ascontiguousarray(part.faces, np.int32)
    return [owned(gl.buffer(array.tobytes())) for array in (table, indices)]


def _set_uniforms(program: moderngl.Program, grain: Grain, gallery: Gallery) -> None:
    values = {
        "noise": 0,
        "coarse_per_mm": tuple(1 / (NOISE_CELLS * size) for size in grain.coarse_mm),
        "fine_per_mm": tuple(1 / (NOISE_CELLS * size) for size in grain.fine_mm),
        "coarse_weights": grain.coarse_weights,
        "fine_weights": grain.fine_weights,
        "freckles": grain.freckles,
        "gloss": grain.gloss,
        "lamps": [tuple(row) for row in gallery.lamps.tolist()],
        "lamp_colours": [tuple(row) for row in gallery.lamp_colours.tolist()],
    }
    for name, value in values.items():
        if name in program:  # one program of the two has no highlights
            program[name] = value


def _draw(
    context: GlContext,
    program: moderngl.Program,
    camera: Camera,
    pieces: Sequence[tuple[Part, list[moderngl.Buffer]]],
    gallery: Gallery,
    *,
    origin: Float[np.ndarray, " 3"],
    box: Float[np.ndarray, "p 3"],
    samples: int,
) -> Float[np.ndarray, "h w 4"]:
    gl = context.gl
    (page,) = pack([camera], context.largest_texture)
    size = (page.width, page.height)
    samples = min(samples, context.most_samples)
    with Owned() as owned:
        row = instances([camera], page, origin, np.array([depth_range(camera, box)]))
        camera_row = (owned(gl.buffer(row.tobytes())), INSTANCE_FORMAT, *INSTANCE_NAMES)
        image = owned(gl.renderbuffer(size, 4, samples=samples, dtype="f2"))
        target = owned(gl.framebuffer([image], owned(gl.depth_renderbuffer(size, samples=samples))))
        resolved = owned(gl.framebuffer([owned(gl.renderbuffer(size, 4, dtype="f2"))]))
        program["atlas_size"] = (float(page.width), float(page.height))
        for turn, (part, (table, indices)) in enumerate(pieces):
            with context.drawing(target, depth=True, cull=part.one_sided):
                if turn == 0:
                    target.clear()
                _set_uniforms(program, part.grain, gallery)
                layout = (table, "3f 3f 3f 4f 3f 1f", "position", "normal", "place", "paint", "irradiance", "oil")
                draw = owned(gl.vertex_array(program, [layout, camera_row], index_buffer=indices))
                draw.render(instances=1)
        gl.copy_framebuffer(resolved, target)
        raw = resolved.read(components=4, dtype="f2")
    return page.cut(np.frombuffer(raw, np.float16).reshape(page.height, page.width, 4), 0).astype(np.float32)
