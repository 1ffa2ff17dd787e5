"""Paints the texture image: reads each texel from the photographs chosen for the vertices of its triangle.

A texel is a point on a triangle of the mesh. A texel's pixel in a photograph is interpolated from the projections of
the triangle's corners. The photograph is read at a texel's pixel with a sub-pixel window, and the corners' colour
correction is added (``pipeline.texturing.neighbourhood``). If different photographs were chosen for the corners, the
photographs are blended. A texel that no camera sees gets the vertices' colours."""

import cv2
import numpy as np
from jaxtyping import Bool, Float, Int, UInt8

from pipeline.compute.threads import map_strips
from pipeline.compute.trace import traced
from pipeline.fusion.refinement import neighbours
from pipeline.fusion.vote_kernels import blurred_over_mesh
from pipeline.geometry.projection import camera_depths
from pipeline.head_model.model import HeadModel
from pipeline.settings import Settings
from pipeline.texturing.layout.uv_unwrap import (
    Atlas,
    Layout,
    ModelLayout,
    NoLayout,
    draw_over_layout,
    lay_out_charts,
    model_layout,
)
from pipeline.texturing.paint_kernels import paint_rows
from pipeline.texturing.vertex_colours import Texture
from pipeline.texturing.visibility import Decision
from pipeline.warnings import ReportWarning
from rig.mesh import Mesh
from rig.messages.message import compose
from rig.rig import Rig

SIZES = (1024, 2048, 4096, 8192)
BUST_SIZE = 2048  # texels at most, if the settings name no size: half a millimetre each
COARSE = 1024  # side of the small image that fills what no triangle covers
BAND_ROWS = 64
ROUNDS = 12  # of a mean of normals: charts follow the shape of the bust, not its pores


def paint_texture(
    layout: Layout, mesh_world: Mesh, colours: UInt8[np.ndarray, "v 3"], decision: Decision, size: int
) -> Atlas:
    """Paints the texture of a head, an image ``size`` texels wide and high.

    Args:
        layout: of the mesh's vertices.
        mesh_world: the head, mm.
        colours: sRGB of its vertices, for what no camera sees and for the padding.
        decision: the views of every vertex, and the photographs.
        size: of the image.
    """
    stored = np.empty((size, size, 3), np.uint8)  # blue first: encoders take it as it is
    beside = np.rint(draw_over_layout(layout, colours[layout.source, ::-1], COARSE)).astype(np.uint8)
    cv2.resize(beside, (size, size), dst=stored, interpolation=cv2.INTER_NEAREST)
    texels = size * layout.uv - 0.5
    choice = decision.choice(colours)
    corners = texels[layout.faces, 1]
    low, high = corners.min(axis=1), corners.max(axis=1)

    def paint(rows: slice) -> None:
        which = np.flatnonzero((high >= rows.start) & (low <= rows.stop - 1))
        paint_rows(
            stored, rows.start, BAND_ROWS, which, texels, layout.faces, layout.source, decision.pictures, choice
        )  # fmt: skip

    map_strips(paint, size, BAND_ROWS)
    return Atlas(layout, stored[:, :, ::-1])


def texture_size(
    layout: Layout, mesh_world: Mesh, views: Rig, region: Int[np.ndarray, " n"], *, wanted: int | None = None
) -> int:
    """Returns the width of the texture in texels. The width is ``wanted`` or, if None, the smallest of ``SIZES`` whose
    texels on the face (the vertices ``region``) are as fine as the photographs' pixels."""
    if wanted is not None:
        return wanted
    inside = layout.faces[np.isin(layout.source[layout.faces], region).all(axis=1)]
    sides = np.roll(inside, -1, axis=1)
    length_mm = np.linalg.norm(
        mesh_world.vertices[layout.source[inside]] - mesh_world.vertices[layout.source[sides]], axis=2
    )
    unit_mm = float(np.median(length_mm / np.linalg.norm(layout.uv[inside] - layout.uv[sides], axis=2)))
    centre = mesh_world.vertices[region].mean(axis=0, keepdims=True)
    pixel_mm = [float(camera_depths(camera, centre)[0]) / camera.intrinsics.fx for camera in views]
    least = unit_mm / min(pixel_mm, default=unit_mm)
    return next((size for size in SIZES if size >= least), SIZES[-1])


def find_layout(model: HeadModel, settings: Settings) -> tuple[ModelLayout | None, list[ReportWarning]]:
    """Returns the head model's UV layout and warnings. The layout is None if no requested file format has a texture, or
    if the model cannot be unwrapped."""
    if not settings.outputs.textured or settings.texture.blend == "reference":
        return None, []
    try:
        return model_layout(model), []
    except NoLayout as reason:
        return None, [compose("no-texture-layout", reason=reason.message)]


@traced
def paint_charts(
    mesh_world: Mesh,
    normals: Float[np.ndarray, "v 3"],
    coloured: Texture,
    head_axes: Float[np.ndarray, "3 3"],
    region: Int[np.ndarray, " n"],
    wanted: int | None = None,
) -> Atlas | None:
    """Paints the texture of a closed mesh (mm) in UV charts along ``head_axes`` (columns, world frame). The texture's
    texels are as fine as the photographs' pixels at the vertices ``region``. Returns None without a ``Decision``."""
    if coloured.decision is None:
        return None
    towards = blurred_over_mesh(normals @ head_axes, *neighbours(mesh_world.faces, len(normals)), ROUNDS)
    layout = lay_out_charts(Mesh(mesh_world.vertices @ head_axes, mesh_world.faces), towards)
    size = wanted or min(BUST_SIZE, texture_size(layout, mesh_world, coloured.decision.views, region))
    return paint_texture(layout, mesh_world, coloured.colours, coloured.decision, size)


@traced
def paint_head(
    layout: ModelLayout | None,
    mesh: Mesh,
    coloured: Texture,
    face_region: Bool[np.ndarray, " v"],
    settings: Settings,
    full_size: Rig | None = None,
) -> Atlas | None:
    """Paints the texture of the head, with texels as fine as the photographs' pixels, or as those of the cameras
    ``full_size``. Returns None if there is no UV layout or no camera saw the head."""
    if layout is None or coloured.decision is None:
        return None
    region = np.flatnonzero(face_region)
    wanted = settings.outputs.texture_size
    size = texture_size(layout.layout, mesh, full_size or coloured.decision.views, region, wanted=wanted)
    return paint_texture(layout.layout, mesh, coloured.colours, coloured.decision, size)
