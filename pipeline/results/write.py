"""Writes the result folder, which docs/capture-format.md describes, and its pictures.

    head.ply  head.glb  report.json  overlays/<camera>.png     fixed by docs/capture-format.md
    bust.ply  bust.glb  the whole visible surface; settings.outputs.surface says which of the two is written, or both
    head_hair.ply  head_hair.glb    on request: the head's vertices pushed out to the hair, in the order of head.ply
    contact_sheet.png   input, silhouette difference before and after the fit (section 5.4), the head from new views
    turntable.png       the head from the right to the left profile
    head.obj head.mtl head.png, head.usdz, head.stl, head.3mf     on request (settings.outputs.formats)
    neutral.glb         on request: the head without its expression
    texture/            on request: albedo.png; with pores colour.png, normals.png and displacement.png
    texture/sets/       a texture of each texture set; of polarised light texture/diffuse and texture/specular
    landmarks.mrk.json  on request: the landmarks as a point list of 3D Slicer

Applications add files and fields of report.json by a ``ResultWriter``. The same input, model, settings and version give
the same bytes, except for the seconds in report.json.
"""

import json
from collections.abc import Sequence
from pathlib import Path
from typing import Protocol, runtime_checkable

import numpy as np
from jaxtyping import Float

from pipeline.compute.threads import task_pool
from pipeline.results.head_files import (
    head_from_world,
    head_mesh,
    head_skin,
    landmarks_document,
    plain_skin,
    write_formats,
    write_head_ply,
)
from pipeline.results.overlays import contact_sheet, difference, overlay, turntable
from pipeline.results.reconstruction import QUALITY, Reconstruction, asset_extras, ply_comments
from pipeline.results.report import report_document
from pipeline.results.report_types import AddedReport
from pipeline.stages.bust import Bust, HairyHead
from rig.capture import Capture, reassign_images
from rig.files import write_atomically
from rig.formats.meshes.glb import scene_glb_bytes
from rig.formats.meshes.ply import write_ply
from rig.formats.meshes.scene import Part, Scene, Skin
from rig.formats.pictures.images import write_image
from rig.mesh import Mesh

SHEET_ROWS = 4  # cameras on the contact sheet
THREADS = 4  # cv2, NumPy and the rasteriser release the interpreter lock, and every file waits for the disk


@runtime_checkable
class ResultWriter(Protocol):
    """Declares the type of a function that writes further files of a result; ``write_result`` calls it in another
    thread."""

    def __call__(self, folder: Path, result: Reconstruction, /) -> AddedReport | None:
        """Writes files into ``folder``, each under a temporary name first. Returns the fields for report.json, or None.
        Raises OSError."""
        ...


def write_result(
    folder: Path, result: Reconstruction, capture: Capture, extra_writers: Sequence[ResultWriter] = ()
) -> None:
    """Writes every file of a result, each under a temporary name first. Raises OSError, as when the disk is full.

    Args:
        folder: the result folder.
        result: the reconstruction.
        capture: the capture that was reconstructed, as it was read.
        extra_writers: functions that write further files, such as the head in a template's vertex order.
    """
    capture = reassign_images(capture, pictures=result.views.assignment)
    head = head_mesh(result)
    with task_pool(THREADS) as pool:
        extra_jobs = [pool.submit(write, folder, result) for write in extra_writers]
        jobs = [
            pool.submit(_write_meshes, folder, result, head),
            pool.submit(_write_overviews, folder, result, capture, head),
            pool.submit(write_neutral, folder, result),
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
    write_ply(
        folder / "bust.ply",
        bust.mesh_world,
        normals=bust.normals,
        colours=bust.colours,
        quality=bust.surface.deviation_mm.astype(np.float32),
        views=bust.views,
        part=bust.surface.part,
        comments=[*ply_comments(result), QUALITY, "part is 0 unseen, 1 skin, 2 hair, 3 clothes"],
    )
    mesh = Mesh(bust.mesh_world.vertices, bust.mesh_world.faces, bust.colours)
    _write_glb(folder / "bust.glb", result, mesh, bust.normals, plain_skin(bust.atlas, result.settings.outputs.image))


def _write_hair(folder: Path, result: Reconstruction, hair: HairyHead) -> None:
    mesh = Mesh(hair.shell.vertices_world, result.mesh_world.faces, hair.colours)
    write_ply(
        folder / "head_hair.ply",
        mesh,
        normals=hair.normals,
        colours=hair.colours,
        quality=hair.shell.height_mm,
        views=hair.views,
        comments=[*ply_comments(result), "quality: height above the skin, mm"],
    )
    skin = plain_skin(hair.atlas, result.settings.outputs.image)
    _write_glb(folder / "head_hair.glb", result, mesh, hair.normals, skin)


def write_neutral(folder: Path, result: Reconstruction) -> None:
    """Writes neutral.glb, with the texture of the photographed head, if the settings request it and the model has
    expressions. Raises OSError."""
    if result.evidence.blendshape_rig is None or not result.settings.outputs.neutral:
        return
    world = result.evidence.blendshape_rig.neutral_world
    mesh = Mesh(world.vertices, world.faces, result.texturing.vertices.colours)
    _write_glb(folder / "neutral.glb", result, mesh, mesh.normals(), head_skin(result, head_mesh(result)))


def _write_glb(
    path: Path, result: Reconstruction, mesh_world: Mesh, normals: Float[np.ndarray, "v 3"], skin: Skin | None = None
) -> None:
    """Writes a coloured mesh in world coordinates as a GLB in the head frame."""
    from_world = head_from_world(result)
    mesh = Mesh(from_world.apply(mesh_world.vertices), mesh_world.faces, mesh_world.colours)
    part = Part("head", mesh, normals @ from_world.rotation.T, skin)
    write_atomically(path, scene_glb_bytes(Scene([part]), asset_extras(result)))


def _write_meshes(folder: Path, result: Reconstruction, head: Mesh) -> None:
    if result.settings.outputs.surface == "bust" and result.bust is not None:
        return
    write_head_ply(folder, result)
    write_formats(folder, result, head)


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
    """Draws the contact sheet, one row for each camera: the front camera first, then cameras spread over the rig."""
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
    if not rows:
        return contact_sheet([[("", panel) for panel in panels]])
    return contact_sheet(rows, ("subject outside the head, such as hair and clothes", "head outside the subject"))
