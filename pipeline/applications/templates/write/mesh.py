"""Writes ``head-NAME.obj`` of a result: the head in a template's vertex order, polygons, groups and texture
coordinates; and ``head_hair-NAME.obj``, the head pushed out to its hair.

World frame, mm, as head.ply and head.obj. If both the result has a texture and the template texture coordinates, the
skin is textured (head-NAME.mtl, head-NAME.jpg, and one more file for each further tile); else the vertices are
coloured.
"""

from pathlib import Path

import numpy as np
from jaxtyping import Int, UInt8

from pipeline.applications.templates.template_file import Template
from pipeline.applications.templates.write.texture import Tile, corner_tiles, skin_polygons, template_textures
from pipeline.results.head_files import ENCODINGS, encoded
from pipeline.results.reconstruction import Reconstruction, ply_comments
from rig.atomic_write import write_atomically
from rig.formats.meshes.obj import MATERIAL
from rig.formats.meshes.polygon_obj import PolygonMesh, polygon_obj_bytes
from rig.mesh import vertex_normals

NO_SKIN = 200  # grey of what no photograph shows
SKIN_SHARE = 0.1  # of a material's polygons on the skin, beyond which it shows the texture: shoulders may be the rest


def write_template(folder: Path, result: Reconstruction, template: Template) -> None:
    """Writes the head in the template's vertex order, with its textures and materials. Raises OSError."""
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
    """Writes the template on the head with its hair, if the result has hair: its vertices keep their places on the
    model's triangles. Raises OSError."""
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
    """Returns the colours of the template's vertices: the head's on the skin, grey elsewhere."""
    return _carry_colours(result.texturing.vertices.colours, result.mesh_world.faces, template)


def _carry_colours(
    colours: UInt8[np.ndarray, "v 3"], faces: Int[np.ndarray, "f 3"], template: Template
) -> UInt8[np.ndarray, "t 3"]:
    """Returns the colours of the template's vertices from those of the model's: grey where it has no skin."""
    attached = template.surface_binding.attachment
    corners = colours[faces[attached.triangles]].astype(float)
    out = np.full((len(template.surface_binding.rest), 3), NO_SKIN, np.uint8)
    out[template.surface_binding.skin] = np.clip(np.rint(np.einsum("nk,nkc->nc", attached.weights, corners)), 0, 255)
    return out


def template_materials(template: Template, files: dict[Tile, str]) -> tuple[PolygonMesh, bytes]:
    """Returns the mesh with a material for each part that has one in its file, or else one for all of it, and the
    material library. Materials of the skin show the image of the tile that most of their skin lies in."""
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
