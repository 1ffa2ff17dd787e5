"""Provides the renderer, which its owner creates, passes on, and closes; and draws depth maps with it, for visibility
(section 4.5: is a vertex occluded in an image?) and for shadows."""

from collections.abc import Sequence

import moderngl
import numpy as np
from jaxtyping import Float, Int, UInt8

from rig.mesh import Mesh
from rig.render.colour import UNLIT, Light, draw_colour
from rig.render.context import GlContext, Owned
from rig.render.photograph import Gallery, Part, draw_photographs, draw_vertex_radiance
from rig.render.silhouettes import SilhouetteSet
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


class Renderer:
    """Draws meshes as the cameras of a rig see them, lens distortion included. It belongs to one thread of one process.

    ``with Renderer.create() as renderer: ...``. Raises EglUnavailable if OpenGL cannot start, and WrongThread if it is
    used in another thread. Meshes are in the world frame, mm; images have row 0 on top. ``scale`` draws the same views
    at another resolution (0.5: half the width).
    """

    def __init__(self, context: GlContext) -> None:
        self.context = context

    @classmethod
    def create(cls) -> "Renderer":
        """Returns a new renderer for this thread. Raises EglUnavailable if OpenGL cannot start."""
        return cls(GlContext())

    def __enter__(self) -> "Renderer":
        return self

    def __exit__(self, *_: object) -> None:
        self.close()

    def close(self) -> None:
        """Frees the renderer. Raises WrongThread in another thread."""
        self.context.close()

    def silhouette_set(self, rig: Rig, faces: Int[np.ndarray, "f 3"], scale: float = 1.0) -> SilhouetteSet:
        """Prepares many evaluations of one mesh topology in all cameras: its masks, and their weighted XOR with given
        ones."""
        return SilhouetteSet(self.context, rig.scaled(scale) if scale != 1.0 else rig, faces)

    def depth(
        self, rig: Rig, vertices_world: Float[np.ndarray, "v 3"], faces: Int[np.ndarray, "f 3"], scale: float = 1.0
    ) -> dict[str, Float[np.ndarray, "_ _"]]:
        """Returns the depth of the nearest surface along the optical axis (z in the camera frame, mm, float32) by
        camera; inf where there is none."""
        return draw_depth(self.context, rig.scaled(scale) if scale != 1.0 else rig, vertices_world, faces)

    def colour(
        self, rig: Rig, mesh: Mesh, scale: float = 1.0, *, samples: int = 4, light: Light = UNLIT
    ) -> dict[str, UInt8[np.ndarray, "_ _ 4"]]:
        """Draws the mesh with its vertex colours (grey if it has none), antialiased. Returns RGB, and coverage as
        alpha, by camera."""
        return draw_colour(self.context, rig.scaled(scale) if scale != 1.0 else rig, mesh, samples, light)

    def photograph(
        self, rig: Rig, parts: Sequence[Part], gallery: Gallery, *, samples: int = 4
    ) -> dict[str, Float[np.ndarray, "_ _ 4"]]:
        """Draws a painted, lit subject. Returns its linear radiance by camera: RGB multiplied by coverage, and coverage
        (float32)."""
        return draw_photographs(self.context, rig, parts, gallery, samples)

    def vertex_radiance(self, part: Part, gallery: Gallery) -> Float[np.ndarray, "v 3"]:
        """Returns the linear RGB (float32) of each vertex of a part, as photographed but without highlights."""
        return draw_vertex_radiance(self.context, part, gallery)
