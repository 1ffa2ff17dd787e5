"""Writes head_hair.ply and head_hair.glb, the head pushed out to its hair, and with a template head_hair-NAME.obj.

They have the vertex order of head.ply and of head-NAME.obj, whose frames they share.
"""

from pathlib import Path

from pipeline.applications.templates.template_file import Template
from pipeline.results.metadata import asset_extras, ply_comments
from pipeline.results.reconstruction import Reconstruction
from pipeline.results.write_template import carried_colours
from pipeline.stages.bust import HairyHead
from rig.atomic_write import write_atomically
from rig.formats.meshes.glb import write_glb
from rig.formats.meshes.ply import write_ply
from rig.formats.meshes.polygon_obj import polygon_obj_bytes
from rig.geometry import RigidTransform
from rig.mesh import Mesh, vertex_normals


def write_hair(folder: Path, result: Reconstruction, hair: HairyHead, template: Template | None) -> None:
    """Writes the head with its hair, and if ``template`` is not None in its vertex order, too. Raises OSError."""
    faces, place = result.mesh_world.faces, result.head.fit.world_from_head
    mesh = Mesh(hair.shell.vertices_world, faces)
    write_ply(
        folder / "head_hair.ply",
        mesh,
        normals=hair.normals,
        colours=hair.colours,
        quality=hair.shell.height_mm,
        views=hair.views,
        comments=[*_comments(result), "quality: height above the skin, mm"],
    )
    head_from_world = RigidTransform(place.rotation, place.translation).inverse()
    turned = Mesh(head_from_world.apply(mesh.vertices), faces, hair.colours)
    extras = asset_extras(result)
    write_glb(
        folder / "head_hair.glb", turned, normals=hair.normals @ place.rotation, colours=hair.colours, extras=extras
    )
    if template is not None:
        _write_in_order(folder, result, hair, template)


def _write_in_order(folder: Path, result: Reconstruction, hair: HairyHead, template: Template) -> None:
    """Writes the template on the pushed-out head: its vertices keep their places on the model's triangles."""
    vertices = template.surface_binding.on(hair.shell.vertices_world, result.mesh_world.faces)
    data = polygon_obj_bytes(
        template.mesh,
        vertices,
        vertex_normals(vertices, template.mesh.triangles()),
        colours=carried_colours(hair.colours, result.mesh_world.faces, template),
        comments=[*_comments(result), f"template {template.name} sha256 {template.source_sha256}"],
    )
    write_atomically(folder / f"head_hair-{template.name}.obj", data)


def _comments(result: Reconstruction) -> list[str]:
    return [line for line in ply_comments(result) if not line.startswith("quality")]
