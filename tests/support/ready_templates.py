"""A template that is bound without a registration: the default model's 5 % level, with an eyeball; lips that part are
made by taking out the skin that the model has between them."""

import numpy as np
import trimesh

from pipeline.applications.templates.carrying import bind_vertices, surface_binding
from pipeline.applications.templates.template_file import Template
from pipeline.head_model.model import HeadModel
from rig.formats.meshes.polygon_obj import PolygonMesh
from rig.mesh import vertex_normals

EYE_CENTRE = np.array([31.0, 12.5, 62.0])
TORN = 2.5  # times as long with the jaw open: edges of the skin between the lips


def parted_faces(model: HeadModel) -> np.ndarray:
    """The triangles of the 5 % level but for those that an open jaw tears."""
    level, mean = model.levels["p95"], model.vertices(np.zeros(0))
    skin = mean[level.rows]
    opened = skin + level.operator @ model.expressions.moved({"jawOpen": 1.0})
    sides = [(skin[level.faces[:, k]], skin[level.faces[:, k - 1]]) for k in range(3)]
    before = np.stack([np.linalg.norm(a - b, axis=1) for a, b in sides], axis=1)
    after = np.stack(
        [np.linalg.norm(opened[level.faces[:, k]] - opened[level.faces[:, k - 1]], axis=1) for k in range(3)], axis=1
    )
    return np.asarray(level.faces[(after < TORN * before).all(axis=1)], np.int32)


def ready_template(model: HeadModel, name: str = "low", *, lips_part: bool = False) -> Template:
    """Returns the template; its last vertices are the left eyeball's."""
    level, mean = model.levels["p95"], model.vertices(np.zeros(0))
    faces = parted_faces(model) if lips_part else level.faces
    ball = trimesh.creation.icosphere(subdivisions=2, radius=12.0)
    skin = mean[level.rows]
    rest = np.concatenate([skin, np.array(ball.vertices) + EYE_CENTRE])
    triangles = np.concatenate([faces, np.array(ball.faces) + len(skin)]).astype(np.int32)
    attachment, _, _ = bind_vertices(skin, vertex_normals(skin, level.faces), mean, model.levels["full"].faces)
    wholes = np.r_[np.full(len(skin), -1), np.zeros(len(ball.vertices), int)]
    corners = triangles.ravel()
    mesh = PolygonMesh(
        rest, np.full(len(triangles), 3, np.int32), corners, np.zeros((0, 2)), np.full(len(corners), -1, np.int32)
    )
    return Template(
        name=name,
        source=f"{name}.obj",
        source_sha256="ef" * 32,
        model_name=model.name,
        model_sha256=model.sha256,
        mesh=mesh,
        surface_binding=surface_binding(rest, np.arange(len(skin)), attachment, wholes),
    )
