"""Writes the fitted head in every format that the settings request.

The files head.ply and head.obj are in the world frame in mm; head.glb and head.usdz in the head frame in metres, y up;
head.stl and head.3mf are closed meshes in mm, z up. All textures have the UV layout of head.glb and head.obj. With a
texture, head.glb has the vertices of head.ply in the same order, then copies of the vertices on the texture's seam.
With a normal map, head.glb has only some of the vertices (``rows_of_ply``).
"""

import math
from dataclasses import replace
from pathlib import Path
from typing import Any

import cv2
import numpy as np
from jaxtyping import Float, UInt8, UInt16

from pipeline.head_model.subdivision import boundary_loops, close_loop
from pipeline.results.reconstruction import QUALITY, Reconstruction, asset_extras, ply_comments
from pipeline.texturing.chart_colours import CODES, ENCODED
from pipeline.texturing.layout.normal_map import map_normals, vertex_tangents
from pipeline.texturing.layout.uv_unwrap import Atlas
from pipeline.texturing.pores.skin_maps import SkinMaps
from pipeline.texturing.sets.specular import Specular
from pipeline.texturing.sets.texture_sets import SetTextures
from pipeline.texturing.visibility import LINEAR
from rig.files import write_atomically
from rig.formats.meshes.glb import scene_glb_bytes
from rig.formats.meshes.markups import MarkupPoint, markups_document
from rig.formats.meshes.ply import write_ply
from rig.formats.meshes.polygon_obj import mtl_bytes, scene_obj_bytes
from rig.formats.meshes.printing import stl_bytes, threemf_bytes
from rig.formats.meshes.scene import Part, Scene, Skin
from rig.formats.meshes.usdz import scene_usdz_bytes
from rig.formats.pictures.exr import write_exr
from rig.formats.pictures.images import encode_image
from rig.geometry import RigidTransform
from rig.mesh import Mesh

LPS_FROM_HEAD = np.array([[1.0, 0.0, 0.0], [0.0, 0.0, -1.0], [0.0, 1.0, 0.0]])
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


def write_head_ply(folder: Path, result: Reconstruction) -> None:
    """Writes head.ply, and its texture head.png if the settings request it. Raises OSError."""
    atlas = result.texturing.atlas
    named = atlas is not None and result.settings.outputs.ply_texture
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
    if atlas is not None and named:
        write_atomically(folder / "head.png", encoded(atlas.image, "png"))


def write_formats(folder: Path, result: Reconstruction, head: Mesh) -> None:
    """Writes the textures and the other head files that ``settings.outputs`` names. Raises NoUsd if the library for USD
    is missing, and OSError.

    Args:
        folder: the result folder.
        result: the reconstruction.
        head: the head's mesh in the head frame, mm.
    """
    formats, atlas = result.settings.outputs.formats, result.texturing.atlas
    if result.texturing.albedo is not None:
        write_atomically(folder / "texture" / "albedo.png", encoded(result.texturing.albedo.atlas.image, "png"))
    if atlas is not None and result.texturing.skin is not None:
        write_skin_maps(folder / "texture", atlas, result.texturing.skin)
    if result.texturing.sets is not None:
        write_set_textures(folder / "texture", result.texturing.sets)
    skin = head_skin(result, head)
    normals = result.texturing.normals @ result.head.fit.world_from_head.rotation
    if "glb" in formats:
        write_atomically(folder / "head.glb", _glb(result, head, normals))
    if "obj" in formats:
        if atlas is not None:
            write_atomically(folder / "head.mtl", mtl_bytes("head.png"))
            write_atomically(folder / "head.png", encoded(atlas.image, "png"))
        part = Part("head", Mesh(result.mesh_world.vertices, head.faces, head.colours), result.texturing.normals, skin)
        write_atomically(folder / "head.obj", scene_obj_bytes(Scene([part]), "head.mtl" if skin else None))
    if "usdz" in formats and atlas is not None:
        photograph = replace(skin, image=encoded(atlas.image, "jpeg"), mime="image/jpeg") if skin else None
        write_atomically(folder / "head.usdz", scene_usdz_bytes(Scene([Part("head", head, normals, photograph)])))
    if {"stl", "3mf"} & set(formats):
        closed = printable(head)
        for name, data_of in (("stl", stl_bytes), ("3mf", threemf_bytes)):
            if name in formats:
                write_atomically(folder / f"head.{name}", data_of(closed))


def head_skin(result: Reconstruction, head: Mesh) -> Skin | None:
    """Returns the texture for the head's files, with normal map and specular map; None without a texture."""
    texturing, kind = result.texturing, result.settings.outputs.image
    atlas, sets = texturing.atlas, texturing.sets
    if atlas is None:
        return None
    strength = None if sets is None or sets.specular is None else strength_png(sets.specular)
    layout, image = atlas.layout, atlas.image
    if result.settings.outputs.albedo == "glb" and texturing.albedo is not None:
        image = texturing.albedo.atlas.image
    elif sets is not None and sets.diffuse is not None and strength is not None:
        image = sets.diffuse.image  # highlights come from the strength
    mime = ENCODINGS[kind][1]
    skin = Skin(layout.uv, encoded(image, kind), mime, layout.source, layout.faces, specular=strength)
    if texturing.skin is None:
        return skin
    normals = texturing.normals @ result.head.fit.world_from_head.rotation
    places = head.vertices[layout.source]
    tangents = vertex_tangents(places, normals[layout.source], layout.uv, layout.faces)
    return replace(skin, normal_map=encode_image(".png", texturing.skin.normals), tangents=tangents)


def plain_skin(atlas: Atlas | None, kind: str) -> Skin | None:
    """Returns a texture without further maps; None without a texture. ``kind`` is a key of ``ENCODINGS``."""
    if atlas is None:
        return None
    of, mime = atlas.layout, ENCODINGS[kind][1]
    return Skin(of.uv, encoded(atlas.image, kind), mime, of.source, of.faces)


def head_mesh(result: Reconstruction) -> Mesh:
    """Returns the result's mesh in the head frame, in true millimetres: the pose's rotation and translation are undone,
    its scale is kept."""
    mesh = result.mesh_world
    return Mesh(head_from_world(result).apply(mesh.vertices), mesh.faces, result.texturing.vertices.colours)


def head_from_world(result: Reconstruction) -> RigidTransform:
    """Returns the rigid transform from the world to the head frame, which keeps lengths in true millimetres."""
    place = result.head.fit.world_from_head
    return RigidTransform(place.rotation, place.translation).inverse()


def _glb(result: Reconstruction, head: Mesh, normals: Float[np.ndarray, "v 3"]) -> bytes:
    """Encodes head.glb, with morph targets if the settings request them."""
    skin, extras, blendshape_rig = head_skin(result, head), asset_extras(result), result.evidence.blendshape_rig
    if result.texturing.reduced is not None and skin is not None and result.texturing.atlas is not None:
        mapped = map_normals(head.vertices, normals, result.texturing.atlas.layout, result.texturing.reduced)
        extras["rows_of_ply"] = mapped.rows.tolist()
        skin = replace(skin, uv=mapped.uv, source=mapped.rows, faces=mapped.mesh.faces)
        skin = replace(skin, normal_map=encode_image(".png", mapped.image), tangents=mapped.tangents)
    elif skin is not None and skin.source is not None:
        extras["repeated_vertices"] = skin.source[len(head.vertices) :].tolist()
    morphs = blendshape_rig.moving if blendshape_rig is not None and result.settings.outputs.morphs else {}
    return scene_glb_bytes(Scene([Part("head", head, normals, skin, morphs)]), extras)


def encoded(image: UInt8[np.ndarray, "s s 3"], kind: str) -> bytes:
    """Returns a texture (sRGB) as the bytes of an image file; ``kind`` is a key of ``ENCODINGS``."""
    suffix, _, options = ENCODINGS[kind]
    return encode_image(suffix, image, options)


def printable(head: Mesh) -> Mesh:
    """Converts the head (head frame, mm) to a closed mesh for 3D printing, with z up and the lowest point at z = 0.
    Raises NotAManifold if a border touches itself."""
    closed = close_borders(head)
    points = closed.vertices[:, [0, 2, 1]] * (1.0, -1.0, 1.0)
    points[:, 2] -= points[:, 2].min()
    return Mesh(points, closed.faces)


def close_borders(head: Mesh) -> Mesh:
    """Closes the openings of the head's mesh (head frame, mm).

    Triangles around the middle of the neck's border close the neck; strips of triangles from corner to corner close
    open lids and lips. Raises NotAManifold if a border touches itself.
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
    return Mesh(np.concatenate(vertices), np.concatenate(added))


def write_set_textures(folder: Path, sets: SetTextures) -> None:
    """Writes the textures of further photographs into ``folder``, each under a temporary name first. Raises OSError."""
    for name, atlas in sets.atlases.items():
        _write_png(folder / "sets" / f"{name}.png", atlas.image)
    if sets.specular is not None and sets.diffuse is not None:
        _write_png(folder / "diffuse.png", sets.diffuse.image)
        write_exr(folder / "diffuse.exr", LINEAR[sets.diffuse.image])
        light = sets.specular.light.astype(np.float32)
        _write_png(folder / "specular.png", ENCODED[(CODES * np.clip(light, 0.0, 1.0) + 0.5).astype(np.int32)])
        write_exr(folder / "specular.exr", light)


def write_skin_maps(folder: Path, atlas: Atlas, maps: SkinMaps) -> None:
    """Writes the displacement and normal maps of the skin into ``folder``, under temporary names first. Raises
    OSError."""
    for name, image in (("colour", atlas.image), ("normals", maps.normals), ("displacement", maps.displacement)):
        _write_png(folder / f"{name}.png", image)


def strength_png(specular: Specular) -> bytes:
    """Encodes glTF's specular strength as the alpha channel of a white PNG."""
    alpha = specular.strength()
    white = np.full_like(alpha, 255)
    return cv2.imencode(".png", cv2.merge([white, white, white, alpha]), PNG_SPEED)[1].tobytes()


def _write_png(path: Path, image: UInt8[np.ndarray, "s s 3"] | UInt16[np.ndarray, "s s"]) -> None:
    write_atomically(path, encode_image(".png", image, PNG_SPEED))


def landmarks_document(result: Reconstruction) -> dict[str, Any]:
    """Returns ``landmarks.mrk.json``, a point list of 3D Slicer, as JSON types. The control points are in the patient's
    axes LPS (left, posterior, superior; mm) with the head frame's origin and true size. A point (x, y, z) of the head
    frame becomes (x, -z, y)."""
    lps_from_world = RigidTransform(LPS_FROM_HEAD, np.zeros(3)) @ head_from_world(result)
    points = {
        name: MarkupPoint(lps_from_world.apply(landmark.position_mm), uncertainty(landmark.std_mm))
        for name, landmark in result.evidence.landmarks.items()
    }
    return markups_document(points, "LPS")


def uncertainty(std_mm: Float[np.ndarray, " 3"] | None) -> str:
    """Formats a landmark's standard deviations as text: the distance's, then those of x, y and z in the world frame."""
    if std_mm is None:
        return "standard deviation unknown"
    x, y, z = (float(value) for value in std_mm)
    return f"standard deviation {math.hypot(x, y, z):.3f} mm; of world x {x:.3f}, y {y:.3f}, z {z:.3f} mm"
