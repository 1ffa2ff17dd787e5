"""The head's colours and texture (section 4.5)."""

from collections.abc import Mapping
from dataclasses import dataclass

import numpy as np
from jaxtyping import Float, Float32

from pipeline.geometry.raster import depth_maps
from pipeline.stages.context import ReconstructionContext
from pipeline.stages.head_fit import HeadFit
from pipeline.stages.recorder import Staged, stage
from pipeline.stages.refined_head import RefinedHead
from pipeline.stages.views import Views
from pipeline.texturing.albedo import DIM_SHARE, Albedo, estimate_albedo
from pipeline.texturing.chart_colours import ChartColours, chart_colours, with_true_colours
from pipeline.texturing.head_texture import find_layout, paint_head
from pipeline.texturing.layout.reduced_layout import ReducedLayout, reduced_layout
from pipeline.texturing.layout.uv_unwrap import Atlas
from pipeline.texturing.vertex_colours import Texture, texture
from rig.capture import Capture


@dataclass(frozen=True, slots=True, eq=False)
class Texturing:
    """Holds the delivered head's vertex colours, and the textures that the settings ask for."""

    normals: Float[np.ndarray, "v 3"]
    depths: Mapping[str, Float32[np.ndarray, "_ _"]]  # mm, of the head in each camera; inf beside it
    capture: Capture  # in its true colours where a chart told them
    vertices: Texture  # a colour a vertex
    atlas: Atlas | None = None  # where a format has a texture and the model a layout
    reduced: ReducedLayout | None = None  # of the atlas, where the settings ask for a normal map
    chart: ChartColours | None = None  # where the settings ask for it and a plate shows one
    albedo: Albedo | None = None  # where the settings ask for it and the light can be estimated


@stage("texture")
def texture_head(
    context: ReconstructionContext, views: Views, head: HeadFit, refined: RefinedHead
) -> Staged[Texturing]:
    """Colours the delivered head from the photographs, and paints its textures."""
    settings, rig, model, mesh = context.settings, context.rig, head.model, refined.mesh_world
    normals, depths, face = mesh.normals(), depth_maps(rig, mesh), model.levels["full"].face_region
    layout, layout_warnings = find_layout(model, settings)
    chart, chart_warnings = chart_colours(views.capture, rig) if settings.texture.chart else (None, [])
    capture = views.capture if chart is None else with_true_colours(views.capture, chart)
    around = None if layout is None else layout.around
    vertices = texture(
        mesh,
        normals,
        capture,
        views.silhouettes,
        rig,
        depths,
        settings=settings.texture,
        around=around,
        dim_share=DIM_SHARE if settings.outputs.delit else None,
    )
    atlas = paint_head(layout, mesh, vertices, face, settings)
    reduced = reduced_layout(model, layout.layout) if layout is not None and settings.outputs.normal_map else None
    albedo, albedo_warnings = None, []
    if settings.outputs.delit:
        albedo, albedo_warnings = estimate_albedo(mesh, normals, vertices, atlas, face, around, chart=chart)
    warnings = (*chart_warnings, *vertices.warnings, *layout_warnings, *albedo_warnings)
    return Staged(Texturing(normals, depths, capture, vertices, atlas, reduced, chart, albedo), warnings)
