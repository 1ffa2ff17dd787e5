"""Draws meshes in all cameras of a rig. Depth maps show which vertices are occluded in an image (the paper's section
4.5) or lie in shadow.

The module also draws a model's silhouettes, and computes their boundary-weighted XOR with the input silhouettes
(section 4.3, eqs. 4 and 5). One instanced draw call draws the silhouettes of all cameras to one shared texture. The
cost ``w |S - Sm|`` is summed in two steps. The GPU adds the pixels of each block of 8 x 8 in single precision, in a
fixed order. The CPU adds the sums of all blocks in double precision. Therefore the relative error of a cost is below 64
* 2^-24 = 4e-6, equal masks cost exactly 0, and the same input always gives the same cost. Pixel blocks that the model
cannot cover get the cost of an empty model.

On two cores with Mesa's llvmpipe, eleven views of 512 x 384 pixels and 4,900 triangles take 8 ms to draw and 2 ms to
add. Adding by atomics, a compute shader or mipmaps was not faster.
"""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass

import moderngl
import numpy as np
from jaxtyping import Bool, Float, Int, UInt8

from rig.camera import lens_image
from rig.errors import InputError
from rig.mesh import Mesh
from rig.messages.message import compose
from rig.render.context import GlContext, Owned
from rig.render.photograph import Gallery, Part, draw_photographs, draw_vertex_radiance
from rig.render.tile_packing import (
    BLOCK_PX,
    INSTANCE_FORMAT,
    INSTANCE_NAMES,
    NEAR_MM,
    Page,
    box_points,
    depth_range,
    instances,
    lens_limit,
    pack,
)
from rig.rig import Rig

GREY = 190


@dataclass(frozen=True, slots=True)
class Light:
    """Holds one distant light. ``towards`` is the unit direction to the light in the world frame, or None for a light
    at the camera."""

    towards: tuple[float, float, float] | None = None
    ambient: float = 0.0


UNLIT = Light(ambient=1.0)
HEADLIGHT = Light(ambient=0.15)


def draw_colour(
    context: GlContext, rig: Rig, mesh: Mesh, samples: int, light: Light
) -> dict[str, UInt8[np.ndarray, "_ _ 4"]]:
    """Draws a mesh in each camera as RGB and coverage (alpha). RGB is the colour of the covered part of a pixel, not
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
    """Draws one texture of ``page`` and returns the mean over ``samples`` samples of each pixel. The returned colours
    are multiplied by the coverage (alpha)."""
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


@dataclass(frozen=True, slots=True, eq=False)
class _Surface:
    """Holds the GPU resources for one page of camera images: the drawn mask, the weights, and the block sums."""

    page: Page
    mask: moderngl.Framebuffer
    blocks: moderngl.Framebuffer
    mask_texture: moderngl.Texture
    weights: moderngl.Texture
    block_sums: moderngl.Texture
    boxes: moderngl.Buffer
    draw: moderngl.VertexArray
    reduce: moderngl.VertexArray


class SilhouetteSet:
    """Draws silhouettes of one mesh many times, while only its vertices change. Callers must close it."""

    def __init__(self, context: GlContext, rig: Rig, faces: Int[np.ndarray, "f 3"]) -> None:
        """Prepares cameras and triangles. Silhouettes are drawn at the image size of ``rig``."""
        self.rig = rig
        self._context = context
        self._faces = np.ascontiguousarray(faces, np.int32)
        self._vertices_needed = int(faces.max()) + 1 if len(faces) else 0
        self._culls = is_closed(faces)
        self._owned = Owned()
        self._origin = rig.centre_world()
        self._limits = [lens_limit(camera) for camera in rig]
        self._empty_sums: list[Float[np.ndarray, "_ _"]] = []
        with context.current() as gl:
            self._indices = self._owned(gl.buffer(self._faces.tobytes())) if len(faces) else None
            self._positions = self._owned(gl.buffer(reserve=max(12 * self._vertices_needed, 12)))
            self._surfaces = [self._surface(page) for page in pack(rig.cameras, context.largest_texture)]

    def __enter__(self) -> "SilhouetteSet":
        return self

    def __exit__(self, *_: object) -> None:
        self.close()

    def close(self) -> None:
        """Frees the GPU's memory."""
        with self._context.current():
            self._owned.close()
        self._surfaces = []

    def masks(self, vertices_world: Float[np.ndarray, "v 3"]) -> dict[str, Bool[np.ndarray, "_ _"]]:
        """Returns the mask of the mesh in each camera. A mask's pixel is True if the mesh covers its centre."""
        silhouettes = {}
        with self._context.current():
            self._draw(vertices_world)
            for surface in self._surfaces:
                page = surface.page
                raw = surface.mask.read(components=1, alignment=1)
                image = np.frombuffer(raw, np.uint8).reshape(page.height, page.width) > 0
                for position, index in enumerate(page.cameras):
                    silhouettes[index] = page.cut(image, position).copy()
        return {camera.name: silhouettes[index] for index, camera in enumerate(self.rig)}

    def set_inputs(
        self, masks: Mapping[str, Bool[np.ndarray, "_ _"]], weights: Mapping[str, Float[np.ndarray, "_ _"]]
    ) -> None:
        """Uploads the input silhouettes and each pixel's weight ``1 / d^2`` of eq. (5) to the GPU.

        Raises InputError if a camera's mask or weights are missing or not of the camera's size.
        """
        check_images(self.rig, masks, "mask")
        check_images(self.rig, weights, "weight")
        self._empty_sums = []
        with self._context.current():
            for surface in self._surfaces:
                page = surface.page
                signed = np.zeros((page.height, page.width), np.float32)
                for position, index in enumerate(page.cameras):
                    name = self.rig.cameras[index].name
                    page.cut(signed, position)[:] = np.where(masks[name], -weights[name], weights[name])
                surface.weights.write(signed.tobytes())
                sums = np.stack([_block_sums(np.maximum(-signed, 0)), _block_sums(np.maximum(signed, 0))], axis=2)
                surface.block_sums.write(sums.astype(np.float32).tobytes())
                self._empty_sums.append(sums[:, :, 0])

    def xor_costs(self, vertices_world: Float[np.ndarray, "v 3"]) -> Float[np.ndarray, " k"]:
        """Returns the cost ``sum w |S - Sm|`` of each camera, in the order of the rig. Call ``set_inputs`` first."""
        if not self._empty_sums:
            raise InputError("xor_costs", [compose("no-input-silhouettes")])
        costs = np.zeros(len(self.rig))
        with self._context.current():
            boxes = self._draw(vertices_world)
            for surface, empty in zip(self._surfaces, self._empty_sums, strict=True):
                page = surface.page
                blocks = np.array([boxes[index] for index in page.cameras]) + np.tile(page.tiles[:, :2] // BLOCK_PX, 2)
                sums = self._reduce(surface, blocks)
                for position, index in enumerate(page.cameras):
                    left, top, right, bottom = blocks[position]
                    tile = _block_tile(page, position)
                    reached = np.s_[top:bottom, left:right]
                    costs[index] = empty[tile].sum() + (sums[reached] - empty[reached]).sum()
        return costs

    def _draw(self, vertices: Float[np.ndarray, "v 3"]) -> Int[np.ndarray, "k 4"]:
        """Draws all masks. Returns, for each camera, the range of blocks that the model may cover."""
        if len(vertices) < self._vertices_needed:
            few = compose("vertices-few", held=len(vertices), wanted=self._vertices_needed)
            raise InputError("vertices", [few])
        if not self._vertices_needed:
            boxes, in_front = np.zeros((len(self.rig), 4), int), True
        else:
            boxes, in_front = self._reach(vertices[: self._vertices_needed])
            relative = (vertices[: self._vertices_needed] - self._origin).astype(np.float32)
            self._positions.write(relative.tobytes())
        for surface in self._surfaces:
            page = surface.page
            with self._context.drawing(surface.mask, cull=self._culls and in_front):
                surface.mask.clear()
                if self._vertices_needed:
                    surface.draw.program["atlas_size"] = (float(page.width), float(page.height))
                    surface.draw.render(instances=len(page.cameras))
        return boxes

    def _reach(self, vertices: Float[np.ndarray, "v 3"]) -> tuple[Int[np.ndarray, "k 4"], bool]:
        """Returns the range of blocks (left, top, right, bottom) that the model may cover in each camera, and whether
        the whole model lies in front of all cameras."""
        box = box_points(vertices)
        boxes, all_in_front = [], True
        for camera, limit in zip(self.rig, self._limits, strict=True):
            k = camera.intrinsics
            whole = np.array([0, 0, -(-k.width // BLOCK_PX), -(-k.height // BLOCK_PX)])
            points = camera.camera_from_world.apply(box)
            in_front = bool(points[:, 2].min() > 2 * NEAR_MM)
            all_in_front &= in_front
            normalised = points[:, :2] / points[:, 2:] if in_front else np.full((1, 2), np.inf)
            if (normalised**2).sum(axis=1).max() < limit**2:  # else the lens may bend the box's edges any way
                pixels = lens_image(points, k.values())
                low, high = np.floor((pixels.min(axis=0) - 2) / BLOCK_PX), np.ceil((pixels.max(axis=0) + 3) / BLOCK_PX)
                low, high = np.clip(low, 0, whole[2:]), np.clip(high, 0, whole[2:])
                boxes.append(np.concatenate([low, high]).astype(int))
            else:
                boxes.append(whole)
        return np.array(boxes), all_in_front

    def _reduce(self, surface: _Surface, blocks: Int[np.ndarray, "k 4"]) -> Float[np.ndarray, "h w"]:
        surface.boxes.write(blocks.astype(np.float32).tobytes())
        surface.mask_texture.use(0)
        surface.weights.use(1)
        surface.block_sums.use(2)
        surface.reduce.program["target_size"] = (float(surface.blocks.width), float(surface.blocks.height))
        with self._context.drawing(surface.blocks, clip=False):
            surface.reduce.render(moderngl.TRIANGLE_STRIP, vertices=4, instances=len(blocks))
        raw = surface.blocks.read(components=1, dtype="f4")
        return np.frombuffer(raw, np.float32).reshape(surface.blocks.height, surface.blocks.width).astype(float)

    def _surface(self, page: Page) -> _Surface:
        gl, owned = self._context.gl, self._owned
        size, block_size = (page.width, page.height), (page.width // BLOCK_PX, page.height // BLOCK_PX)
        mask = owned(gl.texture(size, 1, alignment=1))
        blocks = owned(gl.framebuffer([owned(gl.texture(block_size, 1, dtype="f4"))]))
        weights, block_sums = owned(gl.texture(size, 1, dtype="f4")), owned(gl.texture(block_size, 2, dtype="f4"))
        cameras = owned(gl.buffer(instances(self.rig.cameras, page, self._origin).tobytes()))
        boxes = owned(gl.buffer(reserve=16 * len(page.cameras)))
        drawing = self._context.program("silhouette.vert", "silhouette.frag")
        reducing = self._context.program("box.vert", "xor.frag")
        for unit, name in enumerate(("model", "signed_weight", "block_sums")):
            reducing[name] = unit
        content = [(self._positions, "3f", "position"), (cameras, INSTANCE_FORMAT, *INSTANCE_NAMES)]
        draw = owned(gl.vertex_array(drawing, content, index_buffer=self._indices))
        reduce = owned(gl.vertex_array(reducing, [(boxes, "4f/i", "box")]))
        return _Surface(page, owned(gl.framebuffer([mask])), blocks, mask, weights, block_sums, boxes, draw, reduce)


def is_closed(faces: Int[np.ndarray, "f 3"]) -> bool:
    """Returns whether a mesh is closed, so that its front faces alone form the whole silhouette.

    A ray enters a closed surface as often as it leaves the surface. Every pixel that a back face covers is therefore
    also covered by a front face.
    """
    edges = np.concatenate([faces[:, [0, 1]], faces[:, [1, 2]], faces[:, [2, 0]]]).astype(np.int64)
    base = int(edges.max(initial=0)) + 1
    return np.array_equal(np.sort(edges[:, 0] * base + edges[:, 1]), np.sort(edges[:, 1] * base + edges[:, 0]))


def check_images(rig: Rig, images: Mapping[str, np.ndarray], kind: str) -> None:
    """Raises InputError unless each camera has an image of its size. ``kind`` names the images in messages."""
    faults = []
    for camera in rig:
        wanted = (camera.intrinsics.height, camera.intrinsics.width)
        if camera.name not in images:
            faults.append(compose("camera-without-image", what=kind, camera=camera.name))
        elif images[camera.name].shape[:2] != wanted:
            shape = str(images[camera.name].shape)
            faults.append(compose("image-shape", what=kind, camera=camera.name, shape=shape, wanted=f"{wanted}"))
    if faults:
        raise InputError("silhouettes", faults)


def _block_sums(image: Float[np.ndarray, "h w"]) -> Float[np.ndarray, "h8 w8"]:
    height, width = image.shape
    return image.reshape(height // BLOCK_PX, BLOCK_PX, width // BLOCK_PX, BLOCK_PX).sum(axis=(1, 3), dtype=float)


def _block_tile(page: Page, position: int) -> tuple[slice, slice]:
    left, top, width, height = page.tiles[position]
    return (
        slice(top // BLOCK_PX, -(-(top + height) // BLOCK_PX)),
        slice(left // BLOCK_PX, -(-(left + width) // BLOCK_PX)),
    )


def draw_depth(
    context: GlContext, rig: Rig, vertices_world: Float[np.ndarray, "v 3"], faces: Int[np.ndarray, "f 3"]
) -> dict[str, Float[np.ndarray, "_ _"]]:
    """Returns the depth map of a mesh in each camera: the camera-frame z (mm, float32) at each pixel's centre, or inf
    where no surface is."""
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
    """Draws meshes in the views of a rig's cameras, lens distortion included. Only one thread may use a renderer.

    ``with Renderer.create() as renderer: ...``. Raises EglUnavailable if OpenGL cannot start, and WrongThread if it is
    used in another thread. Meshes are in the world frame (mm). Images have row 0 on top. The parameter ``scale`` of the
    methods scales the images' width and height.
    """

    def __init__(self, context: GlContext) -> None:
        self.context = context

    @classmethod
    def create(cls) -> "Renderer":
        """Creates a renderer for the current thread. Raises EglUnavailable if OpenGL cannot start."""
        return cls(GlContext())

    def __enter__(self) -> "Renderer":
        return self

    def __exit__(self, *_: object) -> None:
        self.close()

    def close(self) -> None:
        """Frees the renderer's resources. Raises WrongThread outside the renderer's thread."""
        self.context.close()

    def silhouette_set(self, rig: Rig, faces: Int[np.ndarray, "f 3"], scale: float = 1.0) -> SilhouetteSet:
        """Prepares to draw the silhouettes of one mesh many times, with other vertices each time."""
        return SilhouetteSet(self.context, rig.scaled(scale) if scale != 1.0 else rig, faces)

    def depth(
        self, rig: Rig, vertices_world: Float[np.ndarray, "v 3"], faces: Int[np.ndarray, "f 3"], scale: float = 1.0
    ) -> dict[str, Float[np.ndarray, "_ _"]]:
        """Returns the depth map of a mesh in each camera: the camera-frame z (mm, float32) of the nearest surface, or
        inf where no surface is."""
        return draw_depth(self.context, rig.scaled(scale) if scale != 1.0 else rig, vertices_world, faces)

    def colour(
        self, rig: Rig, mesh: Mesh, scale: float = 1.0, *, samples: int = 4, light: Light = UNLIT
    ) -> dict[str, UInt8[np.ndarray, "_ _ 4"]]:
        """Draws a mesh with its vertex colours, antialiased; a mesh without colours is grey. Returns RGB, and coverage
        as alpha, by camera."""
        return draw_colour(self.context, rig.scaled(scale) if scale != 1.0 else rig, mesh, samples, light)

    def photograph(
        self, rig: Rig, parts: Sequence[Part], gallery: Gallery, *, samples: int = 4
    ) -> dict[str, Float[np.ndarray, "_ _ 4"]]:
        """Draws the parts of a simulated subject in each camera. Returns linear RGB multiplied by coverage, and
        coverage (float32)."""
        return draw_photographs(self.context, rig, parts, gallery, samples)

    def vertex_radiance(self, part: Part, gallery: Gallery) -> Float[np.ndarray, "v 3"]:
        """Returns the linear RGB (float32) of each vertex of a part in ``photograph``, without highlights."""
        return draw_vertex_radiance(self.context, part, gallery)
