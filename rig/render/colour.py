"""Draws meshes with their vertex colours: results from new viewpoints, overlays, turntables."""

from dataclasses import dataclass

import moderngl
import numpy as np
from jaxtyping import Float, UInt8

from rig.mesh import Mesh
from rig.render.context import GlContext, Owned
from rig.render.tile_packing import INSTANCE_FORMAT, INSTANCE_NAMES, Page, box_points, depth_range, instances, pack
from rig.rig import Rig

GREY = 190


@dataclass(frozen=True, slots=True)
class Light:
    """Holds one distant light. ``towards`` is the unit direction to it, world frame; None puts it at the camera."""

    towards: tuple[float, float, float] | None = None
    ambient: float = 0.0


UNLIT = Light(ambient=1.0)
HEADLIGHT = Light(ambient=0.15)


def draw_colour(
    context: GlContext, rig: Rig, mesh: Mesh, samples: int, light: Light
) -> dict[str, UInt8[np.ndarray, "_ _ 4"]]:
    """Draws a mesh in each camera: RGB and coverage (alpha). RGB is the colour of the covered part of a pixel, not
    mixed with a background."""
    if not len(mesh.faces):
        return {c.name: np.zeros((c.intrinsics.height, c.intrinsics.width, 4), np.uint8) for c in rig}
    origin = rig.centre_world()
    box = box_points(mesh.vertices)
    ranges = np.array([depth_range(camera, box) for camera in rig])
    colours = np.full((len(mesh.vertices), 3), GREY, np.uint8) if mesh.colours is None else mesh.colours
    pictures = {}
    arrays = ((mesh.vertices - origin).astype(np.float32), mesh.normals().astype(np.float32), colours)
    with context.current() as gl, Owned() as owned:
        program = context.program("colour.vert", "colour.frag")
        program["light_direction"] = light.towards or (0.0, 0.0, 0.0)
        program["ambient"] = light.ambient
        buffers = [owned(gl.buffer(np.ascontiguousarray(array).tobytes())) for array in arrays]
        content = list(zip(buffers, ("3f", "3f", "3f1"), ("position", "normal", "colour"), strict=True))
        indices = owned(gl.buffer(np.ascontiguousarray(mesh.faces, np.int32).tobytes()))
        for page in pack(rig.cameras, context.largest_texture):
            rows = owned(gl.buffer(instances(rig.cameras, page, origin, ranges).tobytes()))
            camera = (rows, INSTANCE_FORMAT, *INSTANCE_NAMES)
            draw = owned(gl.vertex_array(program, [*content, camera], index_buffer=indices))
            program["atlas_size"] = (float(page.width), float(page.height))
            image = draw_antialiased(context, draw, page, min(samples, context.most_samples))
            for position, index in enumerate(page.cameras):
                pictures[index] = _straight(page.cut(image, position))
    return {camera.name: pictures[index] for index, camera in enumerate(rig)}


def draw_antialiased(
    context: GlContext, draw: moderngl.VertexArray, page: Page, samples: int
) -> UInt8[np.ndarray, "h w 4"]:
    """Draws one page and returns the mean over ``samples`` samples of each pixel. Its colours are multiplied by the
    coverage (alpha)."""
    gl, size = context.gl, (page.width, page.height)
    with Owned() as owned:
        image = owned(gl.renderbuffer(size, 4, samples=samples))
        target = owned(gl.framebuffer([image], owned(gl.depth_renderbuffer(size, samples=samples))))
        resolved = owned(gl.framebuffer([owned(gl.renderbuffer(size, 4))]))
        with context.drawing(target, depth=True):
            target.clear()
            draw.render(instances=len(page.cameras))
        gl.copy_framebuffer(resolved, target)
        raw = resolved.read(components=4)
    return np.frombuffer(raw, np.uint8).reshape(page.height, page.width, 4)


def _straight(premultiplied: UInt8[np.ndarray, "h w 4"]) -> UInt8[np.ndarray, "h w 4"]:
    image = premultiplied.copy()
    edge = (image[:, :, 3] > 0) & (image[:, :, 3] < 255)
    part: Float[np.ndarray, "n 4"] = image[edge].astype(float)
    image[edge, :3] = np.minimum(np.rint(part[:, :3] * 255 / part[:, 3:]), 255).astype(np.uint8)
    return image
