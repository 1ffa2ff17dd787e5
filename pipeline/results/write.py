"""The result folder of docs/capture-format.md, and the pictures beside it.

    head.ply  head.glb  report.json  overlays/<camera>.png     fixed by docs/capture-format.md
    bust.ply  bust.glb  the whole visible surface; settings.outputs.surface says which of the two is written, or both
    head_hair.ply  head_hair.glb    on request: the head's vertices pushed out to the hair, in the order of head.ply
    contact_sheet.png   input, silhouette difference before and after the fit (section 5.4), the head from new views
    turntable.png       the head from the right to the left profile
    head.obj head.mtl head.png, head.usdz, head.stl, head.3mf     on request (settings.outputs.formats)
    neutral.glb         on request: the head without its expression; posed.glb, with morphs to make others
    texture/            on request: albedo.png; with pores colour.png, normals.png and displacement.png
    texture/sets/       a texture of each texture set; of polarised light texture/diffuse and texture/specular
    landmarks.mrk.json  on request: the landmarks as a point list of 3D Slicer

Applications write further files, and fill fields of report.json, by a ``ResultWriter``. Files of the same input, model,
settings and version are the same bytes, report.json's seconds excepted.
"""

import json
from collections.abc import Sequence
from pathlib import Path
from typing import Protocol, runtime_checkable

import numpy as np

from pipeline.compute.threads import task_pool
from pipeline.evidence.expression import BlendshapeRig
from pipeline.results.head_files import write_head
from pipeline.results.metadata import QUALITY, asset_extras, ply_comments
from pipeline.results.overlays import contact_sheet, difference, overlay, turntable
from pipeline.results.reconstruction import Reconstruction
from pipeline.results.report import report_document
from pipeline.results.report_types import AddedReport
from pipeline.results.slicer_landmarks import landmarks_document
from pipeline.stages.bust import Bust, HairyHead
from rig.atomic_write import write_atomically
from rig.capture import Capture, reassign_images
from rig.formats.meshes.glb import glb_bytes, write_glb
from rig.formats.meshes.morph_glb import with_morphs
from rig.formats.meshes.ply import write_ply
from rig.formats.pictures.images import write_image
from rig.geometry import RigidTransform, Similarity
from rig.mesh import Mesh

SHEET_ROWS = 4  # cameras on the contact sheet
THREADS = 4  # cv2, NumPy and the rasteriser release the interpreter lock, and every file waits for the disk


@runtime_checkable
class ResultWriter(Protocol):
    """Declares what ``write_result`` calls, in a thread of its own, for files that the method does not know."""

    def __call__(self, folder: Path, result: Reconstruction, /) -> AddedReport | None:
        """Writes files of its own into ``folder``, each under a temporary name first. Returns the fields that it fills
        in report.json, or None. Raises OSError."""
        ...


def write_result(
    folder: Path, result: Reconstruction, capture: Capture, extra_writers: Sequence[ResultWriter] = ()
) -> None:
    """Writes every file of a result, each under a temporary name first. Raises OSError, for example if the disk is
    full.

    Args:
        folder: where the files go.
        result: the reconstruction.
        capture: the capture that was reconstructed, as it was read.
        extra_writers: what writes further files of the result, such as the head in a template's vertex order.
    """
    capture = reassign_images(capture, pictures=result.views.assignment)
    head, blendshape_rig = head_mesh(result), result.evidence.blendshape_rig
    with task_pool(THREADS) as pool:
        extra_jobs = [pool.submit(write, folder, result) for write in extra_writers]
        jobs = [
            pool.submit(_write_meshes, folder, result, head),
            pool.submit(_write_overviews, folder, result, capture, head),
            *([] if blendshape_rig is None else [pool.submit(_write_expression, folder, result, blendshape_rig)]),
            *([] if result.bust is None else [pool.submit(_write_bust, folder, result, result.bust)]),
            *([] if result.hair is None else [pool.submit(_write_hair, folder, result, result.hair)]),
            *(pool.submit(_write_overlay, folder, result, capture, name) for name in _shown(result, capture)),
        ]
        for job in jobs:
            job.result()
        added = [job.result() for job in extra_jobs]
    if result.settings.outputs.slicer:
        points = json.dumps(landmarks_document(result), indent=1, allow_nan=False)
        write_atomically(folder / "landmarks.mrk.json", points.encode())
    document: dict[str, object] = {**report_document(result)}
    for fields in added:
        document.update(fields or {})
    text = json.dumps(document, indent=1, allow_nan=False)
    write_atomically(folder / "report.json", text.encode())


def _write_bust(folder: Path, result: Reconstruction, bust: Bust) -> None:
    mesh, place = bust.mesh_world, result.head.fit.world_from_head
    write_ply(
        folder / "bust.ply",
        mesh,
        normals=bust.normals,
        colours=bust.colours,
        quality=bust.surface.deviation_mm.astype(np.float32),
        views=bust.views,
        part=bust.surface.part,
        comments=[*ply_comments(result), QUALITY, "part is 0 unseen, 1 skin, 2 hair, 3 clothes"],
    )
    turned = Mesh(_head_from_world(place).apply(mesh.vertices), mesh.faces, bust.colours)
    extras = asset_extras(result)
    write_glb(folder / "bust.glb", turned, normals=bust.normals @ place.rotation, colours=bust.colours, extras=extras)


def _write_hair(folder: Path, result: Reconstruction, hair: HairyHead) -> None:
    mesh, place = Mesh(hair.shell.vertices_world, result.mesh_world.faces), result.head.fit.world_from_head
    write_ply(
        folder / "head_hair.ply",
        mesh,
        normals=hair.normals,
        colours=hair.colours,
        quality=hair.shell.height_mm,
        views=hair.views,
        comments=[*ply_comments(result), "quality: height above the skin, mm"],
    )
    turned = Mesh(_head_from_world(place).apply(mesh.vertices), mesh.faces, hair.colours)
    extras = asset_extras(result)
    write_glb(
        folder / "head_hair.glb", turned, normals=hair.normals @ place.rotation, colours=hair.colours, extras=extras
    )


def _write_expression(folder: Path, result: Reconstruction, blendshape_rig: BlendshapeRig) -> None:
    """Writes ``neutral.glb`` and ``posed.glb`` if the settings ask for them, with the vertex colours of the
    photographed head."""
    outputs, colours = result.settings.outputs, result.texturing.vertices.colours
    world = blendshape_rig.neutral_world
    neutral = Mesh(_head_from_world(result.head.fit.world_from_head).apply(world.vertices), world.faces, colours)
    glb = glb_bytes(neutral, normals=neutral.normals(), colours=colours)
    if outputs.neutral:
        write_atomically(folder / "neutral.glb", glb)
    if outputs.morphs:
        morphed = with_morphs(glb, neutral.vertices, neutral.faces, blendshape_rig.morphs, blendshape_rig.weights)
        write_atomically(folder / "posed.glb", morphed)


def _write_meshes(folder: Path, result: Reconstruction, head: Mesh) -> None:
    if result.settings.outputs.surface == "bust" and result.bust is not None:
        return
    write_head(folder, result, head)


def head_mesh(result: Reconstruction) -> Mesh:
    """Returns the result's mesh in the head frame, in true millimetres: the rotation and translation of the pose are
    undone, its scale is kept."""
    head_from_world = _head_from_world(result.head.fit.world_from_head)
    mesh = result.mesh_world
    return Mesh(head_from_world.apply(mesh.vertices), mesh.faces, result.texturing.vertices.colours)


def _head_from_world(place: Similarity) -> RigidTransform:
    return RigidTransform(place.rotation, place.translation).inverse()


def _shown(result: Reconstruction, capture: Capture) -> list[str]:
    fitted = result.evidence.fitted_masks
    return [name for name in result.views.silhouettes if name in capture.images and name in fitted]


def _write_overlay(folder: Path, result: Reconstruction, capture: Capture, name: str) -> None:
    distance, labels = result.views.silhouettes[name].distance, result.labels.maps
    parts = labels[name].probability if name in labels else None
    drawn = overlay(capture.images[name], distance, result.evidence.fitted_masks[name], name, parts)
    write_image(folder / "overlays" / f"{name}.png", drawn)


def _write_overviews(folder: Path, result: Reconstruction, capture: Capture, head: Mesh) -> None:
    panels = turntable(head, result.texturing.vertices.colours)
    write_image(folder / "turntable.png", np.hstack(panels))
    write_image(folder / "contact_sheet.png", _sheet(result, capture, _shown(result, capture), panels))


def _sheet(result: Reconstruction, capture: Capture, shown: list[str], panels: list[np.ndarray]) -> np.ndarray:
    """Draws the contact sheet, one row for each camera: the front camera first, then others spread over the rig."""
    front = [name for name in shown if name == result.alignment.front]
    others = [name for name in shown if name != result.alignment.front]
    spread = np.linspace(0, len(others) - 1, min(SHEET_ROWS - len(front), len(others))).round().astype(int)
    views = np.linspace(len(panels) - 1, 0, SHEET_ROWS).round().astype(int)
    rows = []
    for name, view in zip(front + [others[i] for i in spread], views, strict=False):
        image, observed = capture.images[name], result.views.silhouettes[name].mask
        start = result.evidence.start_masks.get(name)
        before = [] if start is None else [("before the fit", difference(image, observed, start))]
        after = ("after the fit", difference(image, observed, result.evidence.fitted_masks[name]))
        rows.append([(name, image), *before, after, ("", panels[view])])
    return contact_sheet(rows or [[("", panel) for panel in panels]])
