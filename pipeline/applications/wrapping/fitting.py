"""Brings a template onto a scan that lies where the mean head lies: first the model, then the template's own vertices.

The first step is that of a template's registration (``templates``), with the scan in the template's place. The second
is that of ``geometry.registration.nonrigid``, with exact closest points of the scan's triangles.
"""

from dataclasses import dataclass

import numpy as np
from jaxtyping import Bool, Float, Int
from scipy.spatial import KDTree

from pipeline.applications.templates.likeness import Likeness, MetSurface, Stage, SurfaceMarks, fit_model_to_mesh
from pipeline.applications.templates.placement import Surface
from pipeline.applications.templates.registration import components, weld
from pipeline.applications.templates.template_file import Template
from pipeline.fusion.untangling import topology_of, untangled
from pipeline.geometry.registration.nonrigid import draw_to_matches
from pipeline.head_model.model import HeadModel, with_expressions
from rig.mesh import vertex_normals
from rig.progress import Progress

# Of each step of the drawing, and how far off (mm) a place of the scan still draws: from the fit's own error to less
# than vertices lie apart.
STIFFNESS = (30.0, 10.0, 3.0, 1.0, 0.3, 0.1, 0.03, 0.03, 0.01, 0.01)
REACH_MM = (6.0, 5.0, 4.0, 3.0, 2.5, 2.0, 2.0, 2.0, 2.0, 2.0)
# The prior stays stronger than for a template: the template's own vertices follow the scan to the end.
STAGES = (
    Stage(5, 10, 25.0, 12.0, 2.0),
    Stage(5, 40, 15.0, 12.0, 1.5),
    Stage(6, None, 10.0, 12.0, 1.0),
    Stage(6, None, 5.0, 0.0, 0.5),
)
CARRYING = 0.02  # stiffness of the template's own shape while the model's head carries it
FOLLOWING = 0.1  # weight there of what follows the skin outside of the face, shoulders, beside 1 of skin
FACE_MM = 20.0  # of the model's face: what is no skin of the template there lies inside


@dataclass(frozen=True, slots=True, eq=False)
class Fitted:
    """Holds a template on a scan, in the frame of the model's mean head (its scale too)."""

    likeness: Likeness  # the model on the scan
    carried: Float[np.ndarray, "t 3"]  # the template as that head carries it
    vertices: Float[np.ndarray, "t 3"]  # and on the scan
    met: Bool[np.ndarray, " t"]  # vertices that lie on the scan; others continue the shape


def fit_template(
    template: Template, model: HeadModel, scan: Surface, marks: SurfaceMarks | None, report: Progress
) -> Fitted:
    """Fits the model with its expressions to a scan (head frame), carries the template with it, and draws the template
    onto the scan."""
    report("fitting the model", 0.3)
    like = fit_model_to_mesh(with_expressions(model), scan, marks, STAGES)
    carried = template.surface_binding.on(like.vertices, model.levels["full"].faces)
    report("drawing the template", 0.6)
    vertices, met = drawn_onto(carried, template, model, scan)
    return Fitted(like, carried, vertices, met)


def drawn_onto(
    carried: Float[np.ndarray, "t 3"], template: Template, model: HeadModel, scan: Surface
) -> tuple[Float[np.ndarray, "t 3"], Bool[np.ndarray, " t"]]:
    """Draws a template onto a scan near it. Returns all vertices, and which of them lie on the scan.

    The parts that have skin are drawn as one surface, from the shape in which the template was registered, so that lips
    and lids stay as smooth as they are there; what lies deeper in them follows by its stiffness. All other parts follow
    the skin (``SurfaceBinding.with_skin``)."""
    binding, target = template.surface_binding, MetSurface(scan)
    welded, joined = weld(surface_of(binding.rest, template.mesh.triangles()))
    first = np.unique(joined, return_index=True)[1]  # a row of the file for every joined vertex
    is_skin = np.zeros(len(welded.vertices), bool)
    is_skin[joined[binding.skin]] = True
    parts = components(welded)
    rows = np.flatnonzero(np.isin(parts, np.unique(parts[is_skin])))
    place = np.full(len(parts), -1)
    place[rows] = np.arange(len(rows))
    faces = place[welded.faces[(place[welded.faces] >= 0).all(axis=1)]].astype(np.int32)
    start, goal, skin = welded.vertices[rows], carried[first][rows], is_skin[rows]
    outside = skin | ~_near_face(start, model)

    known = np.where(skin, 1.0, np.where(outside, FOLLOWING, 0.0))
    start = draw_to_matches(start, faces, lambda shape: (goal, known), (CARRYING,))
    weight = np.zeros(len(rows))
    reaches = iter(REACH_MM)

    def match(shape: Float[np.ndarray, "n 3"]) -> tuple[Float[np.ndarray, "n 3"], Float[np.ndarray, " n"]]:
        nonlocal weight
        stage = Stage(1, None, next(reaches), 0.0, 0.0)
        met, planes, _, weight = target.meet(shape, vertex_normals(shape, faces), stage)
        weight = np.where(outside, weight, 0.0)
        along = np.einsum("nx,nx->n", met - shape, planes)
        return shape + along[:, None] * planes, weight

    drawn = draw_to_matches(start, faces, match, STIFFNESS)
    drawn = untangled(drawn, topology_of(faces, len(drawn)))
    whole, met = np.zeros((len(parts), 3)), np.zeros(len(parts), bool)
    whole[rows], met[rows] = drawn, weight > 0.0
    out = binding.with_skin(whole[joined[binding.skin]])
    in_parts = place[joined] >= 0
    out[in_parts] = whole[joined[in_parts]]
    return out, met[joined]


def surface_of(vertices: Float[np.ndarray, "t 3"], faces: Int[np.ndarray, "f 3"]) -> Surface:
    """Returns a surface with its normals."""
    return Surface(vertices, faces, vertex_normals(vertices, faces))


def _near_face(points: Float[np.ndarray, "n 3"], model: HeadModel) -> Bool[np.ndarray, " n"]:
    """Tells which points of a registered template lie near the face of the mean head: points there that are no skin lie
    in the mouth, the nose or the sockets."""
    mean = model.vertices(np.zeros(0))
    return KDTree(mean[model.levels["full"].face_region]).query(points)[0] < FACE_MM
