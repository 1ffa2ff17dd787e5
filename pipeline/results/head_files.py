"""Writes the fitted head in every format that the settings ask for.

head.ply, head.obj: world frame, mm. head.glb, head.usdz: head frame, metres, y up. head.stl, head.3mf: closed, mm, z
up. texture/albedo.png: in the layout of head.glb and head.obj, if the settings ask for it; so are the textures of
texture sets. With a texture, the first
vertices of head.glb are those of head.ply in the same order; the vertices on the texture's seam follow once more. With
a normal map it has only some of them (``rows_of_ply``).
"""

from dataclasses import replace
from pathlib import Path

import cv2
import numpy as np
from jaxtyping import Float, UInt8

from pipeline.head_model.subdivision import boundary_loops, close_loop
from pipeline.results.metadata import QUALITY, asset_extras, ply_comments
from pipeline.results.reconstruction import Reconstruction
from pipeline.results.skin_files import write_skin_maps
from pipeline.texturing.chart_colours import CODES, ENCODED
from pipeline.texturing.layout.normal_map import normal_mapped, png, vertex_tangents
from pipeline.texturing.layout.uv_unwrap import Atlas
from pipeline.texturing.sets.specular import Specular
from pipeline.texturing.sets.texture_sets import SetTextures
from pipeline.texturing.visibility import LINEAR
from rig.atomic_write import write_atomically
from rig.formats.meshes.glb import Skin, glb_bytes
from rig.formats.meshes.obj import mtl_bytes, obj_bytes, textured_obj_bytes
from rig.formats.meshes.ply import write_ply
from rig.formats.meshes.printing import stl_bytes, threemf_bytes
from rig.formats.meshes.usdz import usdz_bytes
from rig.formats.pictures.exr import write_exr
from rig.mesh import Mesh

JPEG_OPTIONS = (
    cv2.IMWRITE_JPEG_QUALITY, 92, cv2.IMWRITE_JPEG_SAMPLING_FACTOR, cv2.IMWRITE_JPEG_SAMPLING_FACTOR_444
)  # fmt: skip
ENCODINGS = {
    "jpeg": (".jpg", "image/jpeg", JPEG_OPTIONS),
    "webp": (".webp", "image/webp", (cv2.IMWRITE_WEBP_QUALITY, 92)),
    "png": (".png", "image/png", (cv2.IMWRITE_PNG_COMPRESSION, 6)),
}
FAN_MM = 15.0  # a border that reaches so far to all sides is the neck's: it is closed by a fan about its middle
PNG_SPEED = (cv2.IMWRITE_PNG_COMPRESSION, 1)  # level 6 takes four times as long for a tenth of the size


def write_head(folder: Path, result: Reconstruction, head: Mesh) -> None:
    """Writes head.ply and the other head files that ``settings.outputs`` names. Raises NoUsd if the library for USD is
    missing, and OSError.

    Args:
        folder: of the result.
        result: what is written.
        head: the head's mesh in the head frame, mm.
    """
    outputs, formats, atlas = result.settings.outputs, result.settings.outputs.formats, result.texturing.atlas
    named = atlas is not None and outputs.ply_texture
    corner_uv = atlas.layout.uv[atlas.layout.faces] if atlas is not None and named else None
    write_ply(
        folder / "head.ply",
        result.mesh_world,
        normals=result.texturing.normals,
        colours=result.texturing.vertices.colours,
        quality=result.refined.deviation_mm.astype(np.float32),
        views=result.texturing.vertices.views,
        corner_uv=corner_uv,
        comments=[*ply_comments(result), QUALITY, *(["TextureFile head.png"] if named else [])],
    )
    if atlas is not None and (named or "obj" in formats):
        write_atomically(folder / "head.png", encoded(atlas, "png"))
    if result.texturing.albedo is not None:
        write_atomically(folder / "texture" / "albedo.png", encoded(result.texturing.albedo.atlas, "png"))
    if atlas is not None and result.texturing.skin is not None:
        write_skin_maps(folder / "texture", atlas, result.texturing.skin)
    if result.texturing.sets is not None:
        write_set_textures(folder / "texture", result.texturing.sets)
    normals = result.texturing.normals @ result.head.fit.world_from_head.rotation
    if "glb" in formats:
        write_atomically(folder / "head.glb", _glb(result, head, normals))
    if "obj" in formats:
        _write_obj(folder, result)
    if "usdz" in formats and atlas is not None:
        data = usdz_bytes(
            head, normals=normals, uv=atlas.layout.uv, faces_uv=atlas.layout.faces, image=encoded(atlas, "jpeg"),
            suffix=".jpg",
        )  # fmt: skip
        write_atomically(folder / "head.usdz", data)
    if {"stl", "3mf"} & set(formats):
        closed = printable(head)
        for name, data_of in (("stl", stl_bytes), ("3mf", threemf_bytes)):
            if name in formats:
                write_atomically(folder / f"head.{name}", data_of(closed))


def _glb(result: Reconstruction, head: Mesh, normals: np.ndarray) -> bytes:
    atlas, extras, outputs = result.texturing.atlas, asset_extras(result), result.settings.outputs
    if atlas is None:
        return glb_bytes(head, normals=normals, colours=result.texturing.vertices.colours, extras=extras)
    kind = outputs.image
    source, sets = atlas.layout.source, result.texturing.sets
    strength = None if sets is None or sets.specular is None else strength_png(sets.specular)
    if outputs.albedo == "glb" and result.texturing.albedo is not None:
        atlas = result.texturing.albedo.atlas
    elif sets is not None and sets.diffuse is not None and strength is not None:
        atlas = sets.diffuse  # highlights come from the strength
    if result.texturing.reduced is not None:
        mapped = normal_mapped(head.vertices, normals, atlas.layout, result.texturing.reduced)
        extras["rows_of_ply"] = mapped.rows.tolist()
        skin = Skin(mapped.uv, encoded(atlas, kind), ENCODINGS[kind][1], png(mapped.image), mapped.tangents, strength)
        return glb_bytes(mapped.mesh, normals=mapped.normals, skin=skin, extras=extras)
    extras["repeated_vertices"] = source[len(head.vertices) :].tolist()
    opened = Mesh(head.vertices[source], atlas.layout.faces)
    skin = Skin(atlas.layout.uv, encoded(atlas, kind), ENCODINGS[kind][1], specular=strength)
    if result.texturing.skin is not None:
        tangents = vertex_tangents(opened.vertices, normals[source], atlas.layout.uv, atlas.layout.faces)
        skin = replace(skin, normal_map=png(result.texturing.skin.normals), tangents=tangents)
    return glb_bytes(opened, normals=normals[source], skin=skin, extras=extras)


def _write_obj(folder: Path, result: Reconstruction) -> None:
    mesh, atlas = result.mesh_world, result.texturing.atlas
    if atlas is None:
        coloured = Mesh(mesh.vertices, mesh.faces, result.texturing.vertices.colours)
        write_atomically(folder / "head.obj", obj_bytes(coloured))
        return
    layout = atlas.layout
    data = textured_obj_bytes(
        mesh, normals=result.texturing.normals, uv=layout.uv, faces_uv=layout.faces, library="head.mtl"
    )  # fmt: skip
    write_atomically(folder / "head.mtl", mtl_bytes("head.png"))
    write_atomically(folder / "head.obj", data)


def encoded(atlas: Atlas, kind: str) -> bytes:
    """Returns the texture as the bytes of an image file; ``kind`` is a key of ``ENCODINGS``."""
    suffix, _, options = ENCODINGS[kind]
    stored: UInt8[np.ndarray, "s s 3"] = np.ascontiguousarray(atlas.image[:, :, ::-1])  # it is kept blue first
    _, data = cv2.imencode(suffix, stored, list(options))
    return data.tobytes()


def printable(head: Mesh) -> Mesh:
    """Returns the head (head frame, mm) as a closed mesh for printing: z up, standing on z = 0.

    The neck is closed by triangles around the middle of its border; open lids and lips are closed by a strip from
    corner to corner. Raises NotAManifold if a border touches itself.
    """
    vertices, added = [head.vertices], [head.faces]
    count = len(head.vertices)
    for loop in boundary_loops(head.faces):
        border = head.vertices[loop]
        if np.ptp(border, axis=0).min() < FAN_MM and np.ptp(border[:, [0, 2]], axis=0).min() < 2 * FAN_MM:
            added.append(close_loop(head.vertices, loop))
            continue
        ring = np.array(loop)
        added.append(np.stack([np.roll(ring, -1), ring, np.full(len(ring), count)], axis=1).astype(np.int32))
        vertices.append(border.mean(axis=0, keepdims=True))
        count += 1
    points = np.concatenate(vertices)[:, [0, 2, 1]] * (1.0, -1.0, 1.0)
    points[:, 2] -= points[:, 2].min()
    return Mesh(points, np.concatenate(added))


def write_set_textures(folder: Path, sets: SetTextures) -> None:
    """Writes the textures below ``folder``, each under a temporary name first. Raises OSError."""
    for name, atlas in sets.atlases.items():
        _write_png(folder / "sets" / f"{name}.png", atlas.image)
    if sets.specular is not None and sets.diffuse is not None:
        _write_png(folder / "diffuse.png", sets.diffuse.image)
        write_exr(folder / "diffuse.exr", LINEAR[sets.diffuse.image])
        light = sets.specular.light.astype(np.float32)
        _write_png(folder / "specular.png", _encode_light(light))
        write_exr(folder / "specular.exr", light)


def strength_png(specular: Specular) -> bytes:
    """Returns glTF's specular strength as a PNG whose alpha it is; the colours of the pixels are white."""
    alpha = specular.strength()
    return cv2.imencode(".png", cv2.merge([np.full_like(alpha, 255)] * 3 + [alpha]), PNG_SPEED)[1].tobytes()


def _encode_light(light: Float[np.ndarray, "s s 3"]) -> UInt8[np.ndarray, "s s 3"]:
    return ENCODED[(CODES * np.clip(light, 0.0, 1.0) + 0.5).astype(np.int32)]


def _write_png(path: Path, image: UInt8[np.ndarray, "s s 3"]) -> None:
    stored = np.ascontiguousarray(image[:, :, ::-1])
    write_atomically(path, cv2.imencode(".png", stored, PNG_SPEED)[1].tobytes())
