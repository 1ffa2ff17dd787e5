"""Draws a registered template beside the head model it was registered to, so that it can be inspected before use."""

import numpy as np

from pipeline.applications.templates.registration import Registration
from pipeline.applications.templates.template_file import Template
from pipeline.head_model.model import HeadModel
from pipeline.results.clay import SKIN, clay
from pipeline.results.overlays import contact_sheet
from rig.image import ImageRgb
from rig.mesh import Mesh

DEEP, WHOLE = (120, 150, 214), (120, 204, 150)  # what follows the skin, and what moves as a whole
AZIMUTHS_DEG = (0.0, 55.0)


def template_picture(template: Template, found: Registration, model: HeadModel) -> ImageRgb:
    """Draws a template from the front and the side, in five panels: the mesh as it came; the model fitted to it; the
    mesh registered to the model (blue: vertices that follow the skin; green: closed parts that move as a whole); the
    mesh on the model's mean head; and that mean head."""
    faces, triangles = model.levels["full"].faces, template.mesh.triangles()
    mean = model.vertices(np.zeros(0))
    kinds = np.tile(np.array(DEEP), (len(found.surface_binding.rest), 1))
    kinds[found.surface_binding.skin] = SKIN
    kinds[found.surface_binding.wholes >= 0] = WHOLE
    panels = (
        ("as it came", Mesh(found.placed, triangles), None),
        ("the model like it", Mesh(found.head, faces), None),
        ("registered", Mesh(found.surface_binding.rest, triangles), kinds.astype(np.uint8)),
        ("on the mean head", Mesh(found.surface_binding.on(mean, faces), triangles), None),
        ("the mean head", Mesh(mean, faces), None),
    )
    low = np.min([mesh.vertices.min(axis=0) for _, mesh, _ in panels[1:2]] + [mean.min(axis=0)], axis=0)
    high = np.max([mesh.vertices.max(axis=0) for _, mesh, _ in panels[1:2]] + [mean.max(axis=0)], axis=0)
    rows = [
        [(text, clay(mesh, colours=kind, azimuth_deg=turn, box=(low, high))) for text, mesh, kind in panels]
        for turn in AZIMUTHS_DEG
    ]
    return contact_sheet(rows)
