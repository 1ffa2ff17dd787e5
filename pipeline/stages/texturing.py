"""Computes the head's colours and texture (the paper's section 4.5)."""

from collections.abc import Mapping
from dataclasses import dataclass

import numpy as np
from jaxtyping import Bool, Float, Float32

from pipeline.geometry.projection import depth_maps
from pipeline.head_model.regions import halves_of_face, pinnae, scalp
from pipeline.part_labels.codes import Part
from pipeline.stages.context import ReconstructionContext
from pipeline.stages.head_fit import HeadFit
from pipeline.stages.part_labels import PartLabels
from pipeline.stages.recorder import Staged
from pipeline.stages.refined_head import RefinedHead
from pipeline.stages.views import Views
from pipeline.texturing.albedo import DIM_SHARE, Albedo, estimate_albedo
from pipeline.texturing.chart_colours import ChartColours, correct_capture, measure_charts
from pipeline.texturing.layout.normal_map import ReducedLayout, reduce_layout
from pipeline.texturing.layout.uv_unwrap import Atlas
from pipeline.texturing.paint import find_layout, paint_head
from pipeline.texturing.pores.skin_maps import COARSER, CloseViews, SkinMaps, map_skin, read_close_views, skin_share
from pipeline.texturing.sets.texture_sets import SetTextures, colour_by_sets
from pipeline.texturing.vertex_colours import Shown, Texture, colour_vertices
from rig.capture import Capture
from rig.mesh import Mesh
from rig.messages.message import compose


@dataclass(frozen=True, slots=True, eq=False)
class Texturing:
    """Holds the vertex colours of the final head, and the textures that the settings request."""

    normals: Float[np.ndarray, "v 3"]
    depths: Mapping[str, Float32[np.ndarray, "_ _"]]  # mm, of the head in each camera; inf beside it
    capture: Capture  # in its true colours where a chart told them
    vertices: Texture  # a colour a vertex
    atlas: Atlas | None = None  # where a format has a texture and the model a layout
    reduced: ReducedLayout | None = None  # of the atlas, where the settings ask for a normal map
    chart: ChartColours | None = None  # where the settings ask for it and a plate shows one
    albedo: Albedo | None = None  # where the settings ask for it and the light can be estimated
    skin: SkinMaps | None = None  # where the settings ask for pores and the pictures' files are at hand
    sets: SetTextures | None = None  # where the capture has texture sets


def texture_head(
    context: ReconstructionContext, views: Views, head: HeadFit, refined: RefinedHead, labels: PartLabels
) -> Staged[Texturing]:
    """Colours the final head from the photographs, and paints its textures and maps."""
    settings, rig, model, mesh = context.settings, context.rig, head.model, refined.mesh_world
    normals, depths, face = mesh.normals(), depth_maps(rig, mesh), model.levels["full"].face_region
    chart, warnings = measure_charts(views.capture, rig) if settings.texture.chart else (None, [])
    capture = views.capture if chart is None else correct_capture(views.capture, chart)
    layout, of_layout = find_layout(model, settings)
    around = None if layout is None else layout.around
    vertices = colour_vertices(
        mesh,
        capture,
        views.silhouettes,
        rig,
        depths,
        settings=settings.texture,
        around=around,
        dim_share=DIM_SHARE if settings.outputs.albedo != "none" else None,
        shown=Shown(
            np.where(scalp(model), Part.HAIR, Part.SKIN).astype(np.uint8),
            lambda camera, chosen: labels.shares(camera, mesh.vertices[chosen]),
            hairless=pinnae(model),
            face=face,
            compared=halves_of_face(model),
        ),
    )
    warnings += (*vertices.warnings, *of_layout)
    close = _read_pores(context, views, mesh, vertices, face, chart)
    atlas = paint_head(layout, mesh, vertices, face, settings, None if close is None else close.views.scaled(COARSER))
    skin = None
    if close is not None and layout is not None and atlas is not None:
        skin, atlas = map_skin(
            layout,
            atlas,
            mesh,
            normals,
            vertices,
            close,
            face=face,
            skin=skin_share(close.decision, mesh, labels.skin_probability()),
            world_from_head=head.fit.world_from_head,
        )
    reduced = reduce_layout(model, layout.layout) if layout is not None and settings.outputs.normal_map else None
    albedo = None
    if settings.outputs.albedo != "none":
        albedo, of_albedo = estimate_albedo(mesh, normals, vertices, atlas, face, around, chart=chart)
        warnings += of_albedo
    if settings.detail == "pores" and close is None:
        warnings += [compose("no-pores")]
    sets, of_sets = colour_by_sets(
        capture.texture_sets, vertices.decision, mesh, views.silhouettes, layout, atlas=atlas, settings=settings.texture
    )
    made = Texturing(normals, depths, capture, vertices, atlas, reduced, chart, albedo, skin, sets)
    return Staged(made, [*warnings, *of_sets])


def _read_pores(
    context: ReconstructionContext,
    views: Views,
    mesh: Mesh,
    coloured: Texture,
    face: Bool[np.ndarray, " v"],
    chart: ChartColours | None,
) -> CloseViews | None:
    """Reads the full-size pictures for the detail ``pores``. Returns None for other levels of detail, if files are
    missing, and if the head has no texture."""
    if context.settings.detail != "pores" or context.read_original is None or coloured.decision is None:
        return None
    return read_close_views(context.read_original, mesh, coloured, face, sources=views.assignment, chart=chart)
