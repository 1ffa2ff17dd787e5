"""Bakes a scan's colours into a template's texture: a texel is read where its place on the template meets the scan."""

import numpy as np
from jaxtyping import Int, UInt8

from pipeline.applications.templates.write.texture import MAX_TILES, Tile, corner_tiles, filled
from pipeline.applications.wrapping.wrap import Wrapped
from pipeline.geometry.raster_kernels import interpolate, rasterise
from rig.formats.meshes.polygon_obj import fan
from rig.mesh import vertex_normals

SIDES = (1024, 2048)  # of the texture: of a scan with colours of vertices, and of one with a texture
OFF_MM = 3.0  # a texel farther from the scan shows nothing of it
CHUNK = 200_000  # texels whose closest points are searched at once


def vertex_colours(wrapped: Wrapped) -> UInt8[np.ndarray, "t 3"]:
    """Returns the colours of the template's vertices, read from the scan."""
    normals = vertex_normals(wrapped.vertices, wrapped.template.mesh.triangles())
    hits = wrapped.hits(wrapped.vertices, normals)
    return wrapped.placed.scan.colours_at(hits.triangles, hits.weights)


def baked_textures(wrapped: Wrapped) -> dict[Tile, UInt8[np.ndarray, "s s 3"]]:
    """Returns the texture images (sRGB) by UDIM tile, for the tiles that hold a covered triangle; empty if the scan has
    no colours or the template no texture coordinates."""
    mesh, scan = wrapped.template.mesh, wrapped.placed.scan
    tiles = corner_tiles(mesh)
    of_polygon = np.repeat(np.arange(len(mesh.sizes)), mesh.sizes - 2)
    rows = fan(mesh.sizes)
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
    uv = mesh.uv[mesh.corner_uv[corners.ravel()]] - tile
    texels = size * np.stack([uv[:, 0], 1.0 - uv[:, 1]], axis=1) - 0.5
    faces, ones = np.arange(len(uv), dtype=np.int32).reshape(-1, 3), np.ones(len(uv))
    faces.flags.writeable = False  # as the compiled loops know it
    _, shown = rasterise(texels, ones, faces, size, size)
    rows, middle = mesh.corners[corners.ravel()], wrapped.vertices.mean(axis=0)
    normals = vertex_normals(wrapped.vertices, mesh.triangles())
    values = np.concatenate([wrapped.vertices - middle, normals], axis=1)[rows].astype(np.float32)
    read = interpolate(shown, texels, ones, faces, values)
    known = shown >= 0
    image, places = np.zeros((size, size, 3), np.uint8), np.flatnonzero(known)
    for first in range(0, len(places), CHUNK):
        part = places[first : first + CHUNK]
        at = read.reshape(-1, 6)[part].astype(float)
        facing = at[:, 3:] / np.maximum(np.linalg.norm(at[:, 3:], axis=1, keepdims=True), 1e-12)
        hits = wrapped.hits(at[:, :3] + middle, facing)
        image.reshape(-1, 3)[part] = wrapped.placed.scan.colours_at(hits.triangles, hits.weights)
        known.reshape(-1)[part[hits.distances * wrapped.placed.mm_per_unit > OFF_MM]] = False
    return filled(image, known)
