"""Transfers a head's texture to the texture coordinates of a template.

Every texel of the template's layout lies in one of its triangles, whose corners have positions in the model's layout;
the texture is read there. Triangles across the cut of the model's layout are filled from the texels beside them.
Coordinates beyond the unit square are separate tiles (UDIM).
"""

import cv2
import numpy as np
from jaxtyping import Bool, Float, Int, UInt8

from pipeline.applications.templates.carrying import SurfaceBinding
from pipeline.geometry.raster_kernels import interpolate, rasterise
from pipeline.texturing.layout.uv_unwrap import Atlas, Layout
from rig.formats.meshes.polygon_obj import PolygonMesh, fan

MAX_TILES = 10  # a row of UDIM
MAX_TEXELS = 4096  # a side
COARSE = 512  # side of the small image that fills what no triangle covers
NEAR = 0.02  # of the side: so far from known texels the nearest one is repeated, twice as far it has faded
CUT = 0.05  # of the model's layout: a triangle longer than that lies over its cut

Tile = tuple[int, int]


def corner_tiles(mesh: PolygonMesh) -> Int[np.ndarray, "p 2"]:
    """Returns the UDIM tile (column, row) of each polygon: the one that the middle of its texture coordinates lies in.
    (-1, -1) for a polygon without texture coordinates."""
    if not len(mesh.uv):
        return np.full((len(mesh.sizes), 2), -1)
    first = np.cumsum(mesh.sizes) - mesh.sizes
    middle = np.add.reduceat(mesh.uv[mesh.corner_uv], first, axis=0) / mesh.sizes[:, None]
    named = np.minimum.reduceat(mesh.corner_uv, first) >= 0
    tiles = np.floor(np.clip(middle, -1.0, 1e6)).astype(int)
    return np.where((named & (tiles >= 0).all(axis=1))[:, None], tiles, -1)


def skin_polygons(mesh: PolygonMesh, surface_binding: SurfaceBinding) -> Bool[np.ndarray, " p"]:
    """Tells which polygons of the template have all their corners on the skin."""
    skin = np.zeros(len(surface_binding.rest), bool)
    skin[surface_binding.skin] = True
    return np.logical_and.reduceat(skin[mesh.corners], np.cumsum(mesh.sizes) - mesh.sizes)


def template_textures(
    atlas: Atlas, mesh: PolygonMesh, surface_binding: SurfaceBinding
) -> dict[Tile, UInt8[np.ndarray, "s s 3"]]:
    """Returns the texture images (sRGB) of a template, by UDIM tile, for the tiles that its skin lies in; empty if the
    template has no texture coordinates."""
    tiles, on_skin = corner_tiles(mesh), skin_polygons(mesh, surface_binding)
    found = np.unique(tiles[on_skin & (tiles[:, 0] >= 0)], axis=0)
    if not 0 < len(found) <= MAX_TILES:
        return {}
    places = _places(atlas.layout, surface_binding)
    of_polygon = np.repeat(np.arange(len(mesh.sizes)), mesh.sizes - 2)
    rows = fan(mesh.sizes)
    spread = np.ptp(places[mesh.corners[rows]], axis=1).max(axis=1)
    whole = on_skin[of_polygon] & (spread < CUT)
    out = {}
    for tile in found:
        inside = rows[whole & (tiles[of_polygon] == tile).all(axis=1)]
        if len(inside):
            out[int(tile[0]), int(tile[1])] = _tile(atlas, mesh, places, inside, tile)
    return out


def _places(layout: Layout, surface_binding: SurfaceBinding) -> Float[np.ndarray, "t 2"]:
    """Returns the position of each skin vertex in the model's layout; the other vertices lie at its corner."""
    attached = surface_binding.attachment
    out = np.zeros((len(surface_binding.rest), 2))
    out[surface_binding.skin] = np.einsum("nk,nkx->nx", attached.weights, layout.uv[layout.faces[attached.triangles]])
    return out


def _tile(
    atlas: Atlas,
    mesh: PolygonMesh,
    places: Float[np.ndarray, "t 2"],
    corners: Int[np.ndarray, "f 3"],
    tile: Int[np.ndarray, " 2"],
) -> UInt8[np.ndarray, "s s 3"]:
    side = len(atlas.image)
    size = min(side, MAX_TEXELS)
    uv = mesh.uv[mesh.corner_uv[corners.ravel()]] - tile
    texels = size * np.stack([uv[:, 0], 1.0 - uv[:, 1]], axis=1) - 0.5
    faces, ones = np.arange(len(uv), dtype=np.int32).reshape(-1, 3), np.ones(len(uv))
    faces.flags.writeable = False  # as the compiled loops know it
    _, shown = rasterise(texels, ones, faces, size, size)
    values = (side * places[mesh.corners[corners.ravel()]] - 0.5).astype(np.float32)
    read = interpolate(shown, texels, ones, faces, values)
    image = np.asarray(
        cv2.remap(atlas.image, read[..., 0], read[..., 1], cv2.INTER_LINEAR, borderMode=cv2.BORDER_REPLICATE), np.uint8
    )
    return filled(image, shown >= 0)


def filled(image: UInt8[np.ndarray, "s s 3"], known: Bool[np.ndarray, "s s"]) -> UInt8[np.ndarray, "s s 3"]:
    """Returns the image with the nearest known texel where none is, a margin for blurred reading and the cut; farther
    off, shoulders say, the mean colour. The fill is coarse; known texels stay."""
    step = max(1, len(image) // COARSE)
    if not known[::step, ::step].any():
        return image
    beside = np.ascontiguousarray(_extended(image[::step, ::step], known[::step, ::step]))
    out = np.asarray(cv2.resize(beside, known.shape[::-1], interpolation=cv2.INTER_LINEAR), np.uint8)
    cv2.copyTo(image, known.view(np.uint8), out)
    return out


def _extended(image: UInt8[np.ndarray, "c c 3"], known: Bool[np.ndarray, "c c"]) -> UInt8[np.ndarray, "c c 3"]:
    empty = (~known).view(np.uint8)
    away, labels = cv2.distanceTransformWithLabels(empty, cv2.DIST_L2, cv2.DIST_MASK_5, labelType=cv2.DIST_LABEL_PIXEL)
    nearest = np.asarray(labels).astype(np.int32)
    colours = np.zeros((int(nearest.max()) + 1, 3), np.uint8)
    colours[nearest[known]] = image[known]
    far = np.clip((np.asarray(away) - NEAR * len(image)) / (NEAR * len(image)), 0.0, 1.0)[..., None]
    return np.rint((1.0 - far) * colours[nearest] + far * image[known].mean(axis=0)).astype(np.uint8)
