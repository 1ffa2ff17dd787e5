"""Writes a fitted head as ``head-NAME.obj``, in a template's vertex order and with the template's polygons, groups and
texture coordinates. The module also writes ``head_hair-NAME.obj``, the head with its surface moved out to its hair.

The OBJ files are in the world frame, mm, like head.ply and head.obj. If the result has a texture and the template has
texture coordinates, the skin is textured (head-NAME.mtl, head-NAME.jpg, and one more image for each further UDIM tile);
otherwise the vertices are coloured. Each texel of the template's texture lies in a triangle whose corners have
positions in the head model's texture, and its colour is read there. Triangles that cross a seam of the head model's
texture are filled from neighbouring texels. Texture coordinates beyond the unit square belong to separate UDIM tiles.
"""

from pathlib import Path

import cv2
import numpy as np
from jaxtyping import Bool, Float, Float32, Int, UInt8

from pipeline.applications.templates.carrying import SurfaceBinding
from pipeline.applications.templates.template_file import Template
from pipeline.geometry.projection_kernels import interpolate, rasterise
from pipeline.results.head_files import ENCODINGS, encoded
from pipeline.results.reconstruction import Reconstruction, ply_comments
from pipeline.texturing.layout.uv_unwrap import Atlas, Layout
from rig.files import write_atomically
from rig.formats.meshes.polygon_obj import MATERIAL, PolygonMesh, polygon_obj_bytes, triangulate_fan
from rig.mesh import vertex_normals

MAX_TILES = 10  # a row of UDIM
MAX_TEXELS = 4096  # a side
COARSE = 512  # side of the small image that fills what no triangle covers
NEAR = 0.02  # of the side: so far from known texels the nearest one is repeated, twice as far it has faded
CUT = 0.05  # of the model's layout: a triangle longer than that lies over its cut

Tile = tuple[int, int]
NO_SKIN = 200  # grey of vertices without photographs
SKIN_SHARE = 0.1  # of a material's polygons on the skin, beyond which it shows the texture: shoulders may be the rest


def corner_tiles(mesh: PolygonMesh) -> Int[np.ndarray, "p 2"]:
    """Returns the UDIM tile (column, row) that contains the centre of each polygon's texture coordinates; (-1, -1) for
    a polygon without texture coordinates."""
    if not len(mesh.uv):
        return np.full((len(mesh.sizes), 2), -1)
    first = np.cumsum(mesh.sizes) - mesh.sizes
    middle = np.add.reduceat(mesh.uv[mesh.corner_uv], first, axis=0) / mesh.sizes[:, None]
    named = np.minimum.reduceat(mesh.corner_uv, first) >= 0
    tiles = np.floor(np.clip(middle, -1.0, 1e6)).astype(int)
    return np.where((named & (tiles >= 0).all(axis=1))[:, None], tiles, -1)


def skin_polygons(mesh: PolygonMesh, surface_binding: SurfaceBinding) -> Bool[np.ndarray, " p"]:
    """Returns a mask of the template's polygons whose corners are all skin vertices."""
    skin = np.zeros(len(surface_binding.rest), bool)
    skin[surface_binding.skin] = True
    return np.logical_and.reduceat(skin[mesh.corners], np.cumsum(mesh.sizes) - mesh.sizes)


def template_textures(
    atlas: Atlas, mesh: PolygonMesh, surface_binding: SurfaceBinding
) -> dict[Tile, UInt8[np.ndarray, "s s 3"]]:
    """Returns the texture images (sRGB) of a template, by UDIM tile, for all tiles with skin; empty if the template has
    no texture coordinates."""
    tiles, on_skin = corner_tiles(mesh), skin_polygons(mesh, surface_binding)
    found = np.unique(tiles[on_skin & (tiles[:, 0] >= 0)], axis=0)
    if not 0 < len(found) <= MAX_TILES:
        return {}
    places = _places(atlas.layout, surface_binding)
    of_polygon = np.repeat(np.arange(len(mesh.sizes)), mesh.sizes - 2)
    rows = triangulate_fan(mesh.sizes)
    spread = np.ptp(places[mesh.corners[rows]], axis=1).max(axis=1)
    whole = on_skin[of_polygon] & (spread < CUT)
    out = {}
    for tile in found:
        inside = rows[whole & (tiles[of_polygon] == tile).all(axis=1)]
        if len(inside):
            out[int(tile[0]), int(tile[1])] = _tile(atlas, mesh, places, inside, tile)
    return out


def _places(layout: Layout, surface_binding: SurfaceBinding) -> Float[np.ndarray, "t 2"]:
    """Returns each skin vertex's position in the head model's texture; other vertices get the texture's corner."""
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
    values = (side * places[mesh.corners[corners.ravel()]] - 0.5).astype(np.float32)
    read, known = read_in_tile(mesh, corners, tile, size, values)
    image = np.asarray(
        cv2.remap(atlas.image, read[..., 0], read[..., 1], cv2.INTER_LINEAR, borderMode=cv2.BORDER_REPLICATE), np.uint8
    )
    return filled(image, known)


def read_in_tile(
    mesh: PolygonMesh,
    corners: Int[np.ndarray, "f 3"],
    tile: Int[np.ndarray, " 2"],
    size: int,
    values: Float32[np.ndarray, "c k"],
) -> tuple[Float32[np.ndarray, "s s k"], Bool[np.ndarray, "s s"]]:
    """Interpolates values at triangle ``corners`` (of the mesh's polygons) at the texels of a tile; returns the values,
    and a mask of the texels that lie in a triangle."""
    uv = mesh.uv[mesh.corner_uv[corners.ravel()]] - tile
    texels = size * np.stack([uv[:, 0], 1.0 - uv[:, 1]], axis=1) - 0.5
    faces, ones = np.arange(len(uv), dtype=np.int32).reshape(-1, 3), np.ones(len(uv))
    faces.flags.writeable = False  # as the compiled loops know it
    _, shown = rasterise(texels, ones, faces, size, size)
    return interpolate(shown, texels, ones, faces, values), shown >= 0


def filled(image: UInt8[np.ndarray, "s s 3"], known: Bool[np.ndarray, "s s"]) -> UInt8[np.ndarray, "s s 3"]:
    """Returns the image with unknown texels filled: texels near known ones with the nearest known colour, all others
    with the mean colour. Filled texels near the border serve blurred texture reads; known texels do not change."""
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


def write_template(folder: Path, result: Reconstruction, template: Template) -> None:
    """Writes the fitted head in the template's vertex order, with its textures and materials. Raises OSError."""
    head, surface_binding, name = result.mesh_world, template.surface_binding, f"head-{template.name}"
    vertices = surface_binding.on(head.vertices, head.faces)
    textures = (
        {}
        if result.texturing.atlas is None
        else template_textures(result.texturing.atlas, template.mesh, surface_binding)
    )
    kind = "png" if result.settings.outputs.image == "png" else "jpeg"
    suffix = ENCODINGS[kind][0]
    files = {tile: f"{name}{tile_suffix(tile)}{suffix}" for tile in textures}
    for tile, image in textures.items():
        write_atomically(folder / files[tile], encoded(image, kind))
    mesh, library = template.mesh, None
    if textures:
        mesh, materials = template_materials(template, files)
        library = f"{name}.mtl"
        write_atomically(folder / library, materials)
    data = polygon_obj_bytes(
        mesh,
        vertices,
        vertex_normals(vertices, mesh.triangles()),
        colours=None if textures else template_colours(result, template),
        comments=_comments(result, template),
        library=library,
    )
    write_atomically(folder / f"{name}.obj", data)


def write_template_hair(folder: Path, result: Reconstruction, template: Template) -> None:
    """Writes the template deformed to the head with its hair, if the result has hair; each vertex keeps its barycentric
    coordinates in the head model's triangles. Raises OSError."""
    hair, faces = result.hair, result.mesh_world.faces
    if hair is None:
        return
    vertices = template.surface_binding.on(hair.shell.vertices_world, faces)
    data = polygon_obj_bytes(
        template.mesh,
        vertices,
        vertex_normals(vertices, template.mesh.triangles()),
        colours=_carry_colours(hair.colours, faces, template),
        comments=_comments(result, template),
    )
    write_atomically(folder / f"head_hair-{template.name}.obj", data)


def _comments(result: Reconstruction, template: Template) -> list[str]:
    return [*ply_comments(result), f"template {template.name} sha256 {template.source_sha256}"]


def tile_suffix(tile: Tile) -> str:
    """Returns the UDIM number of a tile as a suffix of file names; empty for the first tile."""
    return "" if tile == (0, 0) else f"-{1001 + tile[0] + 10 * tile[1]}"


def template_colours(result: Reconstruction, template: Template) -> UInt8[np.ndarray, "t 3"]:
    """Returns the colours of the template's vertices: the fitted head's colours on the skin, grey elsewhere."""
    return _carry_colours(result.texturing.vertices.colours, result.mesh_world.faces, template)


def _carry_colours(
    colours: UInt8[np.ndarray, "v 3"], faces: Int[np.ndarray, "f 3"], template: Template
) -> UInt8[np.ndarray, "t 3"]:
    """Converts the head model's vertex colours to the template's vertices; vertices outside the skin become grey."""
    attached = template.surface_binding.attachment
    corners = colours[faces[attached.triangles]].astype(float)
    out = np.full((len(template.surface_binding.rest), 3), NO_SKIN, np.uint8)
    out[template.surface_binding.skin] = np.clip(np.rint(np.einsum("nk,nkc->nc", attached.weights, corners)), 0, 255)
    return out


def template_materials(template: Template, files: dict[Tile, str]) -> tuple[PolygonMesh, bytes]:
    """Returns the mesh with its file's materials, or with one material for the whole mesh, and the material library. A
    skin material shows the image of the UDIM tile that holds most of its skin."""
    mesh = template.mesh
    tiles, skin = corner_tiles(mesh), skin_polygons(mesh, template.surface_binding)
    used = [(before, line.partition(" ")[2]) for before, line in mesh.statements if line.startswith("usemtl ")]
    if not used or used[0][0] > 0:
        used.insert(0, (0, MATERIAL))
        statements = ((0, f"usemtl {MATERIAL}"), *mesh.statements)
        mesh = PolygonMesh(mesh.vertices, mesh.sizes, mesh.corners, mesh.uv, mesh.corner_uv, statements)
    ends = [before for before, _ in used[1:]] + [len(mesh.sizes)]
    shown: dict[str, str | None] = {}
    for (first, material), last in zip(used, ends, strict=True):
        part = slice(first, last)
        counted: dict[Tile, int] = {tile: int((skin[part] & (tiles[part] == tile).all(axis=1)).sum()) for tile in files}
        best = max(counted, key=lambda tile, of=counted: of[tile])
        image = files[best] if counted[best] > SKIN_SHARE * (last - first) else None
        shown[material] = shown.get(material) or image
    lines = []
    for material, image in shown.items():
        lines += [f"newmtl {material}", "Ka 1 1 1", "Kd 1 1 1" if image else "Kd 0.8 0.8 0.8", "Ks 0.04 0.04 0.04"]
        lines += ["Ns 20", "illum 2", *([f"map_Kd {image}"] if image else []), ""]
    return mesh, "\n".join(lines).encode()
