"""Writes files of a finished result in other formats, with the writers of the pipeline."""

from dataclasses import replace
from pathlib import Path

import cv2
import numpy as np

from pipeline.applications.clinic.visit import read_visit
from pipeline.applications.templates.write.writers import load_template_writers
from pipeline.applications.verification.measured import identity_of, read_report
from pipeline.contour_fit.fit import Fit
from pipeline.evidence.expression import Found, build_blendshape_rig
from pipeline.evidence.measurements import Landmark
from pipeline.evidence.pose import PoseEvidence
from pipeline.faces.irises import Iris, UnseenEye
from pipeline.head_model.model import HeadModel, load_model
from pipeline.results.head_files import head_mesh, write_formats, write_head_ply
from pipeline.results.reconstruction import Reconstruction
from pipeline.results.report_types import EyeReport
from pipeline.results.write import write_neutral
from pipeline.settings import OutputSettings, settings_from_document
from pipeline.stages.alignment import Alignment
from pipeline.stages.evidence import Evidence
from pipeline.stages.faces import Faces
from pipeline.stages.head_fit import HeadFit
from pipeline.stages.part_labels import PartLabels
from pipeline.stages.refined_head import RefinedHead
from pipeline.stages.texturing import Texturing
from pipeline.stages.views import Views
from pipeline.texturing.albedo import estimate_albedo
from pipeline.texturing.layout.uv_unwrap import Atlas, model_layout
from pipeline.texturing.pores.skin_maps import SkinMaps
from pipeline.texturing.vertex_colours import Texture
from pipeline.warnings import Detail
from rig.capture import Capture
from rig.colour_space import linear_from_srgb
from rig.errors import InputError
from rig.formats.meshes.mesh_file import read_textured_mesh
from rig.geometry import Similarity
from rig.mesh import Mesh
from rig.messages.message import compose, verbatim


def export_result(folder: Path, out: Path, outputs: OutputSettings) -> list[str]:
    """Writes the files that ``outputs`` names of the result in ``folder`` to ``out``, and returns their names.

    Raises InputError for a folder without a result or whose model is not installed, and what the writers raise.
    """
    head_model = load_model(identity_of(folder).model)
    if outputs.morphs and not head_model.expressions.names:
        raise InputError("morphs", [compose("model-without-shapes", model=head_model.name)])
    writers = load_template_writers(outputs.template, head_model)
    result = _read_reconstruction(folder, head_model, outputs)
    out.mkdir(parents=True, exist_ok=True)
    before = {path: path.stat().st_mtime_ns for path in out.rglob("*")}
    if "ply" in outputs.formats:
        write_head_ply(out, result)
    write_formats(out, result, head_mesh(result))
    write_neutral(out, result)
    for write in writers:
        write(out, result)
    written = [path for path in out.rglob("*") if path.is_file() and before.get(path) != path.stat().st_mtime_ns]
    return sorted(path.relative_to(out).as_posix() for path in written)


def _read_reconstruction(folder: Path, model: HeadModel, outputs: OutputSettings) -> Reconstruction:
    """Returns the reconstruction that a result folder describes. Fields that need the photographs are empty. Raises
    InputError."""
    visit, report = read_visit(folder, model.name), read_report(folder)
    mesh, head_from_world = visit.measured.mesh_world, visit.measured.head_from_world
    try:
        settings = replace(settings_from_document(report["settings"], f"{folder.name}/report.json"), outputs=outputs)
        world_from_head = head_from_world.inverse()
        place = Similarity(report["world_from_head"]["scale"], world_from_head.rotation, world_from_head.translation)
        fit = Fit(report["method"], np.array(report["coefficients"]), place, report["evaluations"], "")
        found = [Found(each["name"], each["weight"], each["std"]) for each in report["expression"]]
        eyes = {side: _eye(eye) for side, eye in report.get("eyes", {}).items()}
    except (KeyError, TypeError, ValueError) as error:
        raise InputError(f"{folder.name}/report.json", [compose("report-unread", reason=repr(error))]) from error
    rig = None
    if (outputs.morphs or outputs.neutral) and model.expressions.names:
        rig = build_blendshape_rig(model, place, mesh, found)
    marks = {
        name: Landmark(position, visit.landmark_std_mm.get(name)) for name, position in visit.measured.landmarks.items()
    }
    capture, detail = Capture({}), Detail("fine", verbatim(report["detail"]["reason"]))
    colours = np.asarray(mesh.colours, np.uint8)
    texture = Texture(colours, visit.views, dim=linear_from_srgb(colours / 255.0).astype(np.float32))
    texturing = _read_textures(folder, Texturing(mesh.normals(), {}, capture, texture), model, mesh, outputs)
    return Reconstruction(
        model_name=visit.identity.model,
        model_sha256=visit.identity.sha256,
        settings=settings,
        device=report.get("device", ""),
        digests=report["inputs"],
        views=Views(capture, {}, {}),
        faces=Faces(None, {}, eyes),
        alignment=Alignment(place, report["front"], "silhouettes"),
        labels=PartLabels({}),
        head=HeadFit(fit, model, detail),
        refined=RefinedHead(mesh, visit.measured.stated_mm, detail),
        texturing=texturing,
        bust=None,
        hair=None,
        pose=PoseEvidence("silhouettes", {}, None, False),
        evidence=Evidence({}, {}, {}, marks, {}, tuple(found), rig),
        warnings=(),
        seconds={},
    )


def _eye(eye: EyeReport) -> Iris | UnseenEye:
    """Returns an eye of a report, without its standard deviations."""
    iris, radius, gaze = eye["iris"], eye["radius"], eye["gaze"]
    if iris is None or radius is None or gaze is None:
        return UnseenEye("closed" if eye["cause"] == "closed" else "unclear")
    place, views = np.array(iris["position"]), tuple(eye["views"])
    return Iris(place, np.array(gaze), radius["value"], np.zeros((7, 7)), views)


def _read_textures(folder: Path, bare: Texturing, model: HeadModel, mesh: Mesh, outputs: OutputSettings) -> Texturing:
    """Returns the texturing with the head's texture, the maps of its skin, and its albedo if that is wanted. A missing
    albedo is estimated from the texture alone, so highlights stay in it."""
    image = _head_image(folder)
    if image is None:
        return bare
    layout, around = model_layout(model).layout, model_layout(model).around
    made = replace(bare, atlas=Atlas(layout, image))
    maps = [_read_image(folder / "texture" / f"{name}.png") for name in ("displacement", "normals")]
    if maps[0] is not None and maps[1] is not None:
        made = replace(made, skin=SkinMaps(maps[0], maps[1], (), ()))
    if outputs.albedo == "none":
        return made
    face = model.levels["full"].face_region
    albedo, _ = estimate_albedo(mesh, bare.normals, bare.vertices, made.atlas, face, around)
    stored = _read_image(folder / "texture" / "albedo.png")
    if albedo is not None and stored is not None:
        albedo = replace(albedo, atlas=Atlas(layout, stored))
    return replace(made, albedo=albedo)


def _head_image(folder: Path) -> np.ndarray | None:
    """Returns the texture of head.png or head.glb (sRGB), or None."""
    if (folder / "head.png").is_file() or not (folder / "head.glb").is_file():
        return _read_image(folder / "head.png")
    return read_textured_mesh(folder / "head.glb").image


def _read_image(path: Path) -> np.ndarray | None:
    image = cv2.imdecode(np.fromfile(path, np.uint8), cv2.IMREAD_UNCHANGED) if path.is_file() else None
    return image if image is None or image.ndim == 2 else np.ascontiguousarray(image[:, :, ::-1])
