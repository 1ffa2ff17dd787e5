"""Reads and writes templates as files (npz with a JSON ``meta``): a mesh, and its binding to a head model."""

import io
import json
from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np

from pipeline.applications.templates.carrying import Attachment, SurfaceBinding
from pipeline.applications.templates.flame_model import FlameModel
from pipeline.applications.templates.header import (
    FORMAT,
    WORDS,
    BadTemplate,
    TemplateHeader,
    header_words,
    read_meta,
    template_path,
)
from pipeline.head_model.model import HeadModel
from rig.files import write_atomically
from rig.formats.meshes.pickled_arrays import DAMAGE, open_npz
from rig.formats.meshes.polygon_obj import PolygonMesh
from rig.messages.message import compose

MESH = {"sizes": "i", "corners": "i", "uv": "f", "corner_uv": "i"}
ATTACHMENT = {"triangles": "i", "weights": "f", "offsets": "f"}
FLAME = {
    "template": "f",
    "shape_modes": "f",
    "expression_modes": "f",
    "pose_modes": "f",
    "joint_regressor": "f",
    "weights": "f",
    "parents": "i",
    "faces": "i",
}
CARRIER = {"rest": "f", "skin": "i", "anchors": "i", "wholes": "i", "whole_anchors": "i"}


@dataclass(frozen=True, slots=True, eq=False, kw_only=True)
class Template(TemplateHeader):
    """Holds a mesh registered to a head model. ``mesh.vertices`` equals ``surface_binding.rest``; ``flame`` is the
    FLAME model, if the mesh came from one."""

    mesh: PolygonMesh
    surface_binding: SurfaceBinding
    flame: FlameModel | None = None


def save_template(path: Path, template: Template) -> None:
    """Writes a template file, atomically. Raises OSError."""
    meta = {
        "format": FORMAT,
        **{word: getattr(template, word) for word in WORDS},
        "statements": [list(entry) for entry in template.mesh.statements],
        "figures": dict(template.figures),
    }
    arrays: dict[str, Any] = {"meta": np.frombuffer(json.dumps(meta, sort_keys=True).encode(), np.uint8)}
    parts = (
        (template.mesh, MESH),
        (template.surface_binding.attachment, ATTACHMENT),
        (template.surface_binding, CARRIER),
    )
    for part, kinds in parts:
        arrays |= {name: np.asarray(getattr(part, name), _stored(kind)) for name, kind in kinds.items()}
    if template.flame is not None:
        arrays |= {
            f"flame_{name}": np.asarray(getattr(template.flame, name), _stored(kind)) for name, kind in FLAME.items()
        }
    packed = io.BytesIO()
    np.savez_compressed(packed, **arrays)
    write_atomically(path, packed.getvalue())


def _stored(kind: str) -> type:
    return np.int32 if kind == "i" else np.float32


def read_template(path: Path) -> Template:
    """Reads a template from its file. Raises BadTemplate."""
    try:
        with open_npz(path) as file:
            meta = read_meta(path, file)
            kinds = MESH | ATTACHMENT | CARRIER
            arrays = {name: np.asarray(file[name], int if kinds[name] == "i" else float) for name in kinds}
            flame = _flame(file)
        template = _template(meta, arrays, flame)
    except OSError as error:
        raise BadTemplate(path, error.strerror or compose("file-unreadable")) from None
    except DAMAGE as fault:
        raise BadTemplate(path, compose("file-incomplete", reason=str(fault))) from None
    _check(path, template)
    return template


def _flame(file: Mapping[str, np.ndarray]) -> FlameModel | None:
    if "flame_template" not in file:
        return None
    return FlameModel(
        **{name: np.asarray(file[f"flame_{name}"], int if kind == "i" else float) for name, kind in FLAME.items()}
    )


def _template(meta: dict, arrays: Mapping[str, np.ndarray], flame: FlameModel | None) -> Template:
    statements = tuple((int(before), str(line)) for before, line in meta["statements"])
    mesh = PolygonMesh(
        arrays["rest"], arrays["sizes"], arrays["corners"], arrays["uv"], arrays["corner_uv"], statements
    )
    surface_binding = SurfaceBinding(
        rest=arrays["rest"],
        skin=arrays["skin"],
        attachment=Attachment(*(arrays[name] for name in ATTACHMENT)),
        anchors=arrays["anchors"],
        wholes=arrays["wholes"],
        whole_anchors=arrays["whole_anchors"],
    )
    return Template(
        **header_words(meta), mesh=mesh, surface_binding=surface_binding, figures=meta["figures"], flame=flame
    )


def _check(path: Path, template: Template) -> None:
    """Raises BadTemplate if indices or numbers of a template file are invalid, before a job uses the file."""
    mesh, surface_binding = template.mesh, template.surface_binding
    count = len(surface_binding.rest)
    rows = (mesh.corners, surface_binding.skin, surface_binding.anchors, surface_binding.whole_anchors)
    if any(part.size and (part.min() < 0 or part.max() >= count) for part in rows):
        raise BadTemplate(path, compose("template-vertices-missing"))
    same = (
        len(surface_binding.skin)
        == len(surface_binding.attachment.triangles)
        == len(surface_binding.attachment.weights)
    )
    if not same or len(surface_binding.wholes) != count or mesh.sizes.sum() != len(mesh.corners) != len(mesh.corner_uv):
        raise BadTemplate(path, compose("template-arrays-unfit"))
    numbers = (surface_binding.rest, surface_binding.attachment.weights, surface_binding.attachment.offsets, mesh.uv)
    if not all(np.isfinite(part).all() for part in numbers):
        raise BadTemplate(path, compose("template-not-finite"))
    if template.flame is not None and len(template.flame.template) != count:
        raise BadTemplate(path, compose("template-arrays-unfit"))


def load_template(name: str | None, model: HeadModel) -> Template | None:
    """Loads the named template for a job with the head model ``model``; returns None if ``name`` is None.

    Raises UnknownTemplate, BadTemplate, OtherModel."""
    if name is None:
        return None
    template = read_template(template_path(name))
    template.check_model(model.name, model.sha256)
    return template
