"""The result folder of the contract, and the pictures beside it.

    head.ply  head.glb  report.json  overlays/<camera>.png     fixed by the contract
    bust.ply  bust.glb  the whole visible surface; settings.outputs.surface says which of the two is written, or both
    contact_sheet.png   input, silhouette difference before and after the fit (section 5.4), the head from new views
    turntable.png       the head from the right to the left profile
    head.obj            on request (settings.outputs)
    neutral.glb         on request: the head without its expression; posed.glb, with morphs to make others
    head_atlas.glb      on request: the head of head.glb with a texture that keeps the photographs' resolution

Files of the same input, model, settings and version are the same bytes, report.json's seconds excepted.
"""

import hashlib
import json
from collections.abc import Mapping
from concurrent.futures import ThreadPoolExecutor
from importlib.metadata import version
from pathlib import Path
from typing import Any

import cv2
import numpy as np
from jaxtyping import Float

from pipeline.results.bust import Bust
from pipeline.results.overlays import contact_sheet, difference, overlay, turntable
from pipeline.results.reconstruction import Reconstruction
from pipeline.results.report import report_document
from pipeline.results.write_expression import write_expression
from pipeline.settings import document_from_settings
from pipeline.texture.uv_unwrap import Atlas
from rig.atomic_write import write_atomically
from rig.capture import Capture, refiled
from rig.formats.glb import textured_glb_bytes, write_glb
from rig.formats.images import write_image
from rig.formats.obj import obj_bytes
from rig.formats.ply import write_ply
from rig.geometry import RigidTransform, Similarity
from rig.mesh import Mesh

SHEET_ROWS = 4  # cameras on the contact sheet
JPEG_QUALITY = 95  # of the atlas
THREADS = 4  # cv2, NumPy and the rasteriser release the interpreter lock, and every file waits for the disk


def write_result(folder: Path, result: Reconstruction, capture: Capture) -> None:
    """Writes every file of the result of ``capture``, as it was read; each under a temporary name first. Raises OSError
    where the disk is full."""
    capture = refiled(capture, pictures=result.pictures)
    head = head_mesh(result)
    with ThreadPoolExecutor(max_workers=THREADS) as pool:
        jobs = [
            pool.submit(_write_meshes, folder, result, head),
            pool.submit(_write_overviews, folder, result, capture, head),
            *([] if result.posable is None else [pool.submit(write_expression, folder, result, result.posable)]),
            *([] if result.bust is None else [pool.submit(_write_bust, folder, result, result.bust)]),
            *(pool.submit(_write_overlay, folder, result, capture, name) for name in _shown(result, capture)),
        ]
        for job in jobs:
            job.result()
    text = json.dumps(report_document(result), indent=1, allow_nan=False)
    write_atomically(folder / "report.json", text.encode())


def _write_bust(folder: Path, result: Reconstruction, bust: Bust) -> None:
    mesh, place = bust.mesh_world, result.fit.world_from_head
    write_ply(
        folder / "bust.ply",
        mesh,
        normals=bust.normals,
        colours=bust.colours,
        quality=bust.surface.deviation_mm.astype(np.float32),
        views=bust.views,
        part=bust.surface.part,
        comments=[*ply_comments(result), "part is 0 unseen, 1 skin, 2 hair, 3 clothes"],
    )
    turned = Mesh(_head_from_world(place).apply(mesh.vertices), mesh.faces, bust.colours)
    write_glb(folder / "bust.glb", turned, normals=bust.normals @ place.rotation, colours=bust.colours)


def _write_meshes(folder: Path, result: Reconstruction, head: Mesh) -> None:
    if result.settings.outputs.surface == "bust" and result.bust is not None:
        return
    head_normals = result.normals @ result.fit.world_from_head.rotation
    write_ply(
        folder / "head.ply",
        result.mesh_world,
        normals=result.normals,
        colours=result.colours,
        quality=result.quality_mm.astype(np.float32),
        views=result.views,
        comments=ply_comments(result),
    )
    write_glb(folder / "head.glb", head, normals=head_normals, colours=result.colours)
    if result.settings.outputs.obj:
        coloured = Mesh(result.mesh_world.vertices, result.mesh_world.faces, result.colours)
        write_atomically(folder / "head.obj", obj_bytes(coloured))
    if result.atlas is not None:
        write_atomically(folder / "head_atlas.glb", _atlas_glb(result.atlas, head, head_normals))


def _atlas_glb(atlas: Atlas, head: Mesh, normals: Float[np.ndarray, "v 3"]) -> bytes:
    source = atlas.layout.source
    options = [
        cv2.IMWRITE_JPEG_QUALITY,
        JPEG_QUALITY,
        cv2.IMWRITE_JPEG_SAMPLING_FACTOR,
        cv2.IMWRITE_JPEG_SAMPLING_FACTOR_444,
    ]
    _, jpeg = cv2.imencode(".jpg", np.ascontiguousarray(atlas.image[:, :, ::-1]), options)
    opened = Mesh(head.vertices[source], atlas.layout.faces)
    return textured_glb_bytes(opened, normals=normals[source], uv=atlas.layout.uv, jpeg=jpeg.tobytes())


def head_mesh(result: Reconstruction) -> Mesh:
    """The result mesh in the head frame, at its true size: the pose is undone, the scale is not, so that the GLB's
    metres are metres."""
    head_from_world = _head_from_world(result.fit.world_from_head)
    return Mesh(head_from_world.apply(result.mesh_world.vertices), result.mesh_world.faces, result.colours)


def _head_from_world(place: Similarity) -> RigidTransform:
    return RigidTransform(place.rotation, place.translation).inverse()


def ply_comments(result: Reconstruction) -> list[str]:
    """What the mesh is and what the job that made it was given: no ids, no times, so that the bytes repeat."""
    return [
        "unit mm",
        "frame world",
        f"model {_ascii(result.model_name)} sha256 {result.model_sha256}",
        f"job inputs sha256 {document_sha256(result.digests)}",
        f"job settings sha256 {document_sha256(document_from_settings(result.settings))}",
        f"version eigenhead {version('eigenhead')}",
        "quality is the posterior standard deviation in mm, views the number of images that coloured a vertex",
    ]


def document_sha256(document: Mapping[str, Any]) -> str:
    """sha256 of the canonical JSON of a document."""
    return hashlib.sha256(json.dumps(document, sort_keys=True, separators=(",", ":")).encode()).hexdigest()


def _ascii(text: str) -> str:
    """A PLY header is lines of ASCII."""
    return "".join(c if c.isascii() and c.isprintable() else "?" for c in text)


def _shown(result: Reconstruction, capture: Capture) -> list[str]:
    return [name for name in result.silhouettes if name in capture.images and name in result.fitted_masks]


def _write_overlay(folder: Path, result: Reconstruction, capture: Capture, name: str) -> None:
    distance = result.silhouettes[name].distance
    parts = result.parts[name].probability if name in result.parts else None
    drawn = overlay(capture.images[name], distance, result.fitted_masks[name], name, parts)
    write_image(folder / "overlays" / f"{name}.png", drawn)


def _write_overviews(folder: Path, result: Reconstruction, capture: Capture, head: Mesh) -> None:
    panels = turntable(head, result.colours)
    write_image(folder / "turntable.png", np.hstack(panels))
    write_image(folder / "contact_sheet.png", _sheet(result, capture, _shown(result, capture), panels))


def _sheet(result: Reconstruction, capture: Capture, shown: list[str], panels: list[np.ndarray]) -> np.ndarray:
    """A row a camera: the front one first, then others spread over the rig's order."""
    others = [name for name in shown if name != result.front]
    front = [result.front] if result.front in shown else []
    spread = np.linspace(0, len(others) - 1, min(SHEET_ROWS - len(front), len(others))).round().astype(int)
    views = np.linspace(len(panels) - 1, 0, SHEET_ROWS).round().astype(int)
    rows = []
    for name, view in zip(front + [others[i] for i in spread], views, strict=False):
        image, observed = capture.images[name], result.silhouettes[name].mask
        start = result.start_masks.get(name)
        before = [] if start is None else [("before the fit", difference(image, observed, start))]
        after = ("after the fit", difference(image, observed, result.fitted_masks[name]))
        rows.append([(name, image), *before, after, ("", panels[view])])
    return contact_sheet(rows or [[("", panel) for panel in panels]])
