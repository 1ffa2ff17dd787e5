"""Writes a wrapped scan: the template's OBJ with its texture, the residual map, a report, and a picture."""

import io
import json
from pathlib import Path
from typing import Any

import numpy as np
from jaxtyping import Int, UInt8

from pipeline.applications.templates.write.mesh import (
    MAX_TILES,
    Tile,
    corner_tiles,
    filled,
    read_in_tile,
    template_materials,
    tile_suffix,
)
from pipeline.applications.wrapping.wrap import Wrapped, residual_colours
from pipeline.results.overlays import clay, contact_sheet
from rig.files import write_atomically
from rig.formats.meshes.ply import ply_bytes
from rig.formats.meshes.polygon_obj import polygon_obj_bytes, triangulate_fan
from rig.formats.pictures.images import write_image
from rig.image import ImageRgb
from rig.mesh import Mesh, vertex_normals

SIDES = (1024, 2048)  # of the texture: of a scan with colours of vertices, and of one with a texture
OFF_MM = 3.0  # a texel farther from the scan shows nothing of it
CHUNK = 200_000  # texels whose closest points are searched at once

FORMAT = "eigenhead-wrap/1"
JPEG_QUALITY = 95
AZIMUTHS_DEG, CLOSE_MM, CLOSE_UP = (0.0, 50.0), 85.0, (640, 480)


def write_wrapped(folder: Path, wrapped: Wrapped) -> dict[str, Any]:
    """Writes wrapped.obj (.mtl, .jpg), residual.ply, residual.npz, wrap.json and wrap.png. Returns the content of
    wrap.json. Raises OSError."""
    _write_obj(folder, wrapped)
    _write_residuals(folder, wrapped)
    document = document_of(wrapped)
    write_atomically(folder / "wrap.json", (json.dumps(document, indent=1) + "\n").encode())
    write_image(folder / "wrap.png", wrap_picture(wrapped))
    return document


def document_of(wrapped: Wrapped) -> dict[str, Any]:
    """Returns the content of wrap.json."""
    placed, template = wrapped.placed, wrapped.template
    place = placed.head_from_scan
    return {
        "format": FORMAT,
        "scan": placed.scan.name,
        "template": {"name": template.name, "sha256": template.source_sha256, "model": template.model_name},
        "unit": placed.unit,
        "mm_per_unit": placed.mm_per_unit,
        "up": placed.up,
        "front": placed.front,
        "turned_over": placed.turned_over,
        "face_views": placed.views,
        "head_from_scan": {
            "scale": place.scale, "rotation": place.rotation.tolist(), "translation": place.translation.tolist()
        },
        "figures": wrapped.figures(),
    }  # fmt: skip


def _write_obj(folder: Path, wrapped: Wrapped) -> None:
    template, textures = wrapped.template, baked_textures(wrapped)
    files = {tile: f"wrapped{tile_suffix(tile)}.jpg" for tile in textures}
    for tile, image in textures.items():
        write_image(folder / files[tile], image, quality=JPEG_QUALITY)
    mesh, library = template.mesh, None
    if textures:
        mesh, materials = template_materials(template, files)
        library = "wrapped.mtl"
        write_atomically(folder / library, materials)
    data = polygon_obj_bytes(
        mesh,
        wrapped.vertices,
        vertex_normals(wrapped.vertices, mesh.triangles()),
        colours=vertex_colours(wrapped) if wrapped.placed.scan.is_coloured and not textures else None,
        comments=[f"{wrapped.placed.scan.name} in the vertex order of {template.name} sha256 {template.source_sha256}"],
        library=library,
        decimals=4 + max(0, int(np.ceil(np.log10(wrapped.placed.mm_per_unit)))),  # a tenth of a micrometre
    )
    write_atomically(folder / "wrapped.obj", data)


def _write_residuals(folder: Path, wrapped: Wrapped) -> None:
    triangles = wrapped.template.mesh.triangles()
    colours = residual_colours(wrapped.distance_mm, wrapped.covered)
    data = ply_bytes(
        Mesh(wrapped.vertices, triangles),
        normals=vertex_normals(wrapped.vertices, triangles),
        colours=colours,
        quality=wrapped.distance_mm,
        views=wrapped.covered.astype(np.uint8),
        comments=["quality: distance of the vertex from the scan, mm", "views: 1 where the scan has a surface"],
    )
    write_atomically(folder / "residual.ply", data)
    packed = io.BytesIO()
    np.savez_compressed(
        packed, distance_mm=wrapped.distance_mm.astype(np.float32), covered=wrapped.covered.astype(np.uint8)
    )
    write_atomically(folder / "residual.npz", packed.getvalue())


def wrap_picture(wrapped: Wrapped) -> ImageRgb:
    """Draws the scan in grey clay, the template on it, and the residuals, from front and side, with close-ups."""
    scan = wrapped.placed.surface()  # both in the frame and scale of the mean head
    template = Mesh(wrapped.placed.head_from_scan.apply(wrapped.vertices), wrapped.template.mesh.triangles())
    colours = residual_colours(wrapped.distance_mm, wrapped.covered)
    box = (template.vertices.min(axis=0), template.vertices.max(axis=0))
    middle = wrapped.placed.marks.points.mean(axis=0)
    close = (middle - CLOSE_MM, middle + CLOSE_MM)
    meshes = (
        ("the scan", Mesh(scan.vertices, scan.faces), None),
        ("in the template's order", template, None),
        ("its distance: yellow 0.5 mm, red 1 mm", template, colours),
    )
    rows = []
    for turn in AZIMUTHS_DEG:
        rows.append([(text, clay(mesh, colours=kind, azimuth_deg=turn, box=box)) for text, mesh, kind in meshes])
        rows.append([
            ("", clay(mesh, colours=kind, azimuth_deg=turn, box=close, panel=CLOSE_UP)) for _, mesh, kind in meshes
        ])  # fmt: skip
    return contact_sheet(rows)


def vertex_colours(wrapped: Wrapped) -> UInt8[np.ndarray, "t 3"]:
    """Returns the colours of the template's vertices, read from the scan."""
    normals = vertex_normals(wrapped.vertices, wrapped.template.mesh.triangles())
    hits = wrapped.hits(wrapped.vertices, normals)
    return wrapped.placed.scan.colours_at(hits.triangles, hits.weights)


def baked_textures(wrapped: Wrapped) -> dict[Tile, UInt8[np.ndarray, "s s 3"]]:
    """Returns the texture images (sRGB) by UDIM tile, for tiles with a triangle on the scan; empty if the scan has no
    colours or the template no texture coordinates."""
    mesh, scan = wrapped.template.mesh, wrapped.placed.scan
    tiles = corner_tiles(mesh)
    of_polygon = np.repeat(np.arange(len(mesh.sizes)), mesh.sizes - 2)
    rows = triangulate_fan(mesh.sizes)
    covered = wrapped.covered[mesh.corners[rows]].any(axis=1)
    found = np.unique(tiles[of_polygon[covered]], axis=0)
    found = found[(found >= 0).all(axis=1)]
    if not scan.is_coloured or not 0 < len(found) <= MAX_TILES:
        return {}
    size = SIDES[scan.painted.image is not None]
    return {
        (int(tile[0]), int(tile[1])): _tile(wrapped, rows[(tiles[of_polygon] == tile).all(axis=1)], tile, size)
        for tile in found
    }


def _tile(
    wrapped: Wrapped, corners: Int[np.ndarray, "f 3"], tile: Int[np.ndarray, " 2"], size: int
) -> UInt8[np.ndarray, "s s 3"]:
    mesh = wrapped.template.mesh
    rows, middle = mesh.corners[corners.ravel()], wrapped.vertices.mean(axis=0)
    normals = vertex_normals(wrapped.vertices, mesh.triangles())
    values = np.concatenate([wrapped.vertices - middle, normals], axis=1)[rows].astype(np.float32)
    read, known = read_in_tile(mesh, corners, tile, size, values)
    image, places = np.zeros((size, size, 3), np.uint8), np.flatnonzero(known)
    for first in range(0, len(places), CHUNK):
        part = places[first : first + CHUNK]
        at = read.reshape(-1, 6)[part].astype(float)
        facing = at[:, 3:] / np.maximum(np.linalg.norm(at[:, 3:], axis=1, keepdims=True), 1e-12)
        hits = wrapped.hits(at[:, :3] + middle, facing)
        image.reshape(-1, 3)[part] = wrapped.placed.scan.colours_at(hits.triangles, hits.weights)
        known.reshape(-1)[part[hits.distances * wrapped.placed.mm_per_unit > OFF_MM]] = False
    return filled(image, known)
