"""Depth maps, for visibility (section 4.5: is a vertex occluded in an image?) and for shadows."""

import moderngl
import numpy as np
from jaxtyping import Float, Int

from rig.render.context import GlContext, Owned
from rig.render.tile_packing import INSTANCE_FORMAT, INSTANCE_NAMES, Page, box_points, depth_range, instances, pack
from rig.rig import Rig


def draw_depth(
    context: GlContext, rig: Rig, vertices_world: Float[np.ndarray, "v 3"], faces: Int[np.ndarray, "f 3"]
) -> dict[str, Float[np.ndarray, "_ _"]]:
    """Draws the depth map of a mesh in each camera: the camera-frame z (mm, float32) at each pixel's centre; inf where
    there is nothing."""
    if not len(faces):
        return {c.name: np.full((c.intrinsics.height, c.intrinsics.width), np.inf, np.float32) for c in rig}
    origin = rig.centre_world()
    box = box_points(vertices_world)
    ranges = np.array([depth_range(camera, box) for camera in rig])
    found = {}
    with context.current() as gl, Owned() as owned:
        positions = owned(gl.buffer((vertices_world - origin).astype(np.float32).tobytes()))
        indices = owned(gl.buffer(np.ascontiguousarray(faces, np.int32).tobytes()))
        content = [(positions, "3f", "position")]
        for page in pack(rig.cameras, context.largest_texture):
            raw = _draw_page(context, page, content, indices, instances(rig.cameras, page, origin, ranges))
            for position, index in enumerate(page.cameras):
                found[index] = page.cut(raw, position).copy()
    return {camera.name: found[index] for index, camera in enumerate(rig)}


def _draw_page(
    context: GlContext, page: Page, content: list, indices: moderngl.Buffer, rows: Float[np.ndarray, "k 30"]
) -> Float[np.ndarray, "h w"]:
    size = (page.width, page.height)
    gl, program = context.gl, context.program("depth.vert", "depth.frag")
    with Owned() as owned:
        cameras = (owned(gl.buffer(rows.tobytes())), INSTANCE_FORMAT, *INSTANCE_NAMES)
        image, depth = owned(gl.texture(size, 1, dtype="f4")), owned(gl.depth_renderbuffer(size))
        target = owned(gl.framebuffer([image], depth))
        draw = owned(gl.vertex_array(program, [*content, cameras], index_buffer=indices))
        program["atlas_size"] = (float(page.width), float(page.height))
        with context.drawing(target, depth=True):
            target.clear(red=np.inf)
            draw.render(instances=len(page.cameras))
        raw = target.read(components=1, dtype="f4")
    return np.frombuffer(raw, np.float32).reshape(page.height, page.width)
