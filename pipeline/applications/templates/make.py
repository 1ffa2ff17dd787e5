"""Makes a template file for the command ``eigenhead template add``. Jobs with a template do not import this module."""

from collections.abc import Iterable, Mapping
from pathlib import Path

import numpy as np
from jaxtyping import Float

from pipeline.applications.templates.flame_model import JOINTS, FlameModel
from pipeline.applications.templates.registration import Registration, register
from pipeline.applications.templates.template_file import Template
from pipeline.head_model.model import HeadModel
from pipeline.results.overlays import SKIN, clay, contact_sheet
from rig.errors import InputError
from rig.files import sha256_of
from rig.formats.meshes.pickled_arrays import DAMAGE, open_npz, read_pickled_arrays
from rig.formats.meshes.polygon_obj import PolygonMesh, read_polygons
from rig.image import ImageRgb
from rig.mesh import Mesh
from rig.messages.message import Message, compose
from rig.progress import Progress


def make_template(
    path: Path,
    name: str,
    model: HeadModel,
    *,
    landmarks: Mapping[str, Float[np.ndarray, " 3"]] | None = None,
    report: Progress,
) -> tuple[Template, Registration]:
    """Registers a mesh to a head model; the mesh comes from an OBJ file or a FLAME model's file. Returns the template
    and the registration. Raises InputError that lists every fault of the mesh file."""
    flame = read_flame(path) if path.suffix.lower() in SUFFIXES else None
    mesh = read_polygons(path) if flame is None else _polygons(flame)
    found = register(mesh, model, name=path.name, landmarks=landmarks, report=report)
    kept = PolygonMesh(found.surface_binding.rest, mesh.sizes, mesh.corners, mesh.uv, mesh.corner_uv, mesh.statements)
    template = Template(
        name=name,
        source=path.name,
        source_sha256=sha256_of(path),
        model_name=model.name,
        model_sha256=model.sha256,
        mesh=kept,
        surface_binding=found.surface_binding,
        figures=found.figures(),
        flame=flame,
    )
    return template, found


def _polygons(flame: FlameModel) -> PolygonMesh:
    """Returns the mean head of a FLAME model as a mesh without texture coordinates."""
    corners = flame.faces.ravel().astype(np.int32)
    nowhere = np.full(len(corners), -1, np.int32)
    return PolygonMesh(flame.template, np.full(len(flame.faces), 3, np.int32), corners, np.zeros((0, 2)), nowhere)


SUFFIXES = (".pkl", ".npz")
SHAPES = 300  # modes of shape at the beginning of shapedirs
NAMES = ("v_template", "shapedirs", "posedirs", "J_regressor", "weights", "kintree_table", "f")


def read_flame(path: Path) -> FlameModel:
    """Returns the FLAME model stored in a file. Raises InputError that lists every fault of the FLAME file."""
    arrays = read_pickled_arrays(path) if path.suffix.lower() == ".pkl" else _archive(path)
    faults = [compose("flame-array-missing", name=name) for name in NAMES if name not in arrays]
    faults = faults or [*_unfit(arrays)] or [*_not_finite(arrays)]
    if faults:
        raise InputError(path.name, faults)
    modes = arrays["shapedirs"].astype(float)
    parents = arrays["kintree_table"][0].astype(np.int64)  # the root's own is 2^32 - 1 in published files
    parents[0] = -1
    return FlameModel(
        template=arrays["v_template"].astype(float),
        shape_modes=modes[:, :, :SHAPES],
        expression_modes=modes[:, :, SHAPES:],
        pose_modes=arrays["posedirs"].astype(float),
        joint_regressor=arrays["J_regressor"].astype(float),
        weights=arrays["weights"].astype(float),
        parents=parents,
        faces=arrays["f"].astype(np.int32),
    )


def _archive(path: Path) -> dict[str, np.ndarray]:
    try:
        with open_npz(path) as file:
            return {name: file[name] for name in NAMES if name in file}
    except (OSError, *DAMAGE) as fault:
        raise InputError(path.name, [compose("file-incomplete", reason=str(fault))]) from None


def _unfit(arrays: Mapping[str, np.ndarray]) -> Iterable[Message]:
    """Returns a fault for each array whose shape is not that of a FLAME model."""
    count = len(arrays["v_template"]) if arrays["v_template"].ndim else 0
    wanted = {
        "v_template": (count, 3),
        "posedirs": (count, 3, 9 * (JOINTS - 1)),
        "J_regressor": (JOINTS, count),
        "weights": (count, JOINTS),
        "kintree_table": (2, JOINTS),
    }
    for name, shape in wanted.items():
        if arrays[name].shape != shape:
            yield compose("flame-array-unfit", name=name, shape=str(arrays[name].shape), wanted=str(shape))
    modes, faces = arrays["shapedirs"].shape, arrays["f"].shape
    if len(modes) != 3 or modes[:2] != (count, 3) or modes[2] <= SHAPES:
        yield compose("flame-array-unfit", name="shapedirs", shape=str(modes), wanted=f"({count}, 3, {SHAPES} + ...)")
    if len(faces) != 2 or faces[1] != 3:
        yield compose("flame-array-unfit", name="f", shape=str(faces), wanted="(..., 3)")


def _not_finite(arrays: Mapping[str, np.ndarray]) -> Iterable[Message]:
    count = len(arrays["v_template"])
    above, faces = arrays["kintree_table"][0, 1:].astype(np.int64), arrays["f"].astype(np.int64)
    bad = {
        "kintree_table": not ((above >= 0) & (above < np.arange(1, JOINTS))).all(),
        "f": not len(faces) or faces.min() < 0 or faces.max() >= count,
    }
    for name in NAMES:
        if bad.get(name, False) or not np.isfinite(arrays[name].astype(float)).all():
            yield compose("flame-not-finite", name=name)


DEEP, WHOLE = (120, 150, 214), (120, 204, 150)  # vertices that follow the skin, and parts that move as a whole
AZIMUTHS_DEG = (0.0, 55.0)


def template_picture(template: Template, found: Registration, model: HeadModel) -> ImageRgb:
    """Draws five panels, each from the front and the side: the original mesh; the head model fitted to it; the mesh
    registered to the model (blue: skin vertices; green: closed parts that move as a whole); the mesh on the model's
    mean head; and that mean head."""
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
