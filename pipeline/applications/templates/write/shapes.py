"""``head-NAME.glb`` and ``head-NAME-shapes.npz`` of a result: the template's mesh without expression, with shapes.

Head frame; the GLB in metres, the archive in mm. Vertices keep the template's order; in the GLB, eyeballs are parts of
their own (``extras.rows`` of a node says which vertices it has). Eyeballs, teeth and a tongue that the mesh lacks are
added, and have none. With the formats OBJ and USDZ, ``head-NAME-parts.obj`` and ``head-NAME-parts.usdz`` are the same
without shapes: parts by name.
"""

import io
import json
from collections.abc import Mapping
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
from jaxtyping import Float, Int, UInt8

from pipeline.applications.templates.animated import AnimatedMesh, animated_mesh
from pipeline.applications.templates.eyeballs import AHEAD, turn_to
from pipeline.applications.templates.inner_mouth import WITH_JAW
from pipeline.applications.templates.template_file import Template
from pipeline.applications.templates.write.mesh import template_colours
from pipeline.evidence.expression import BlendshapeRig
from pipeline.faces.irises import Iris, UnseenEye
from pipeline.head_model.visemes import VISEMES
from pipeline.results.metadata import asset_extras
from pipeline.results.reconstruction import Reconstruction
from rig.atomic_write import write_atomically
from rig.formats.meshes.glb import glb_bytes
from rig.formats.meshes.morph_glb import with_morphs
from rig.formats.meshes.parts_files import PlacedPart, parts_obj_bytes, parts_usdz_bytes
from rig.formats.meshes.pivot_glb import NECK, MovingPart, with_pivots
from rig.geometry import RigidTransform
from rig.mesh import Mesh, vertex_normals

FORMAT = "eigenhead-shapes/1"
JAW = "jaw"


def write_template_shapes(folder: Path, result: Reconstruction, template: Template) -> None:
    """Writes the template's mesh with morph targets and pivots, and the same as arrays, if the settings ask for morphs
    and the model has shapes. Raises OSError."""
    blendshape_rig = result.evidence.blendshape_rig
    if blendshape_rig is None or not result.settings.outputs.morphs:
        return
    place, model = result.head.fit.world_from_head, result.head.model
    head_from_world = RigidTransform(place.rotation, place.translation).inverse()
    vertices = head_from_world.apply(blendshape_rig.neutral_world.vertices)
    triangles, colours = template.mesh.triangles(), template_colours(result, template)
    animated = animated_mesh(
        template.surface_binding,
        triangles,
        vertices,
        blendshape_rig.neutral_world.faces,
        blendshape_rig.morphs,
        model.landmarks,
        gazes=_gazes(result.faces.eyes, head_from_world),
    )
    name = f"head-{template.name}"
    extras = asset_extras(result) | {"template": template.name, "template_sha256": template.source_sha256}
    extras |= {"inner_mouth": animated.inner.absence or "added"}
    data = animated_glb(animated, triangles, colours, blendshape_rig.weights, extras)
    write_atomically(folder / f"{name}.glb", data)
    write_atomically(folder / f"{name}-shapes.npz", _archive(animated, template, blendshape_rig))
    formats = result.settings.outputs.formats
    if "obj" in formats or "usdz" in formats:
        parts = animated_parts(animated, triangles, colours)
        if "obj" in formats:
            write_atomically(folder / f"{name}-parts.obj", parts_obj_bytes(parts))
        if "usdz" in formats:
            write_atomically(folder / f"{name}-parts.usdz", parts_usdz_bytes(parts))


def _gazes(eyes: Mapping[str, Iris | UnseenEye], head_from_world: RigidTransform) -> dict[str, Float[np.ndarray, " 3"]]:
    """Returns where eyes that are seen look, by pivot (head frame)."""
    return {f"eye_{side}": head_from_world.rotation @ eye.gaze for side, eye in eyes.items() if isinstance(eye, Iris)}


def animated_parts(
    animated: AnimatedMesh, triangles: Int[np.ndarray, "g 3"], colours: UInt8[np.ndarray, "t 3"]
) -> dict[str, PlacedPart]:
    """Returns the mesh without expression by named parts (head frame, mm): head, eyeballs about their pivots, turned as
    the eyes look, teeth and tongue."""
    turning = np.zeros(len(animated.neutral), bool)
    eyes = {name: replace(eyeball, gaze=AHEAD).mesh() for name, eyeball in animated.added.items()}
    for name, rows in animated.eyeballs.items():
        turning[rows] = True
        eyes[name] = _part(animated, triangles, colours, rows)
    out = {"head": PlacedPart(_part(animated, triangles, colours, np.flatnonzero(~turning)), RigidTransform.identity())}
    for name, mesh in eyes.items():
        pivot = animated.pivots[name]
        place = RigidTransform(turn_to(animated.gazes.get(name, AHEAD)), pivot)
        out[name] = PlacedPart(Mesh(mesh.vertices - pivot, mesh.faces, mesh.colours), place)
    return out | {name: PlacedPart(mesh, RigidTransform.identity()) for name, mesh in animated.inner.parts.items()}


def animated_glb(
    animated: AnimatedMesh,
    triangles: Int[np.ndarray, "g 3"],
    colours: UInt8[np.ndarray, "t 3"],
    weights: Mapping[str, float],
    extras: Mapping[str, object],
) -> bytes:
    """Encodes an animated mesh: morph targets by name, nodes at its pivots, eyeballs as parts of their own."""
    turning = np.zeros(len(animated.neutral), bool)
    for rows in animated.eyeballs.values():
        turning[rows] = True
    rows = np.flatnonzero(~turning)
    head = _part(animated, triangles, colours, rows)
    glb = glb_bytes(head, normals=vertex_normals(head.vertices, head.faces), colours=head.colours, extras=extras)
    morphs = {name: shape[rows] for name, shape in animated.shapes.items()}
    glb = with_morphs(glb, head.vertices, head.faces, morphs, weights)
    parts = {name: _part(animated, triangles, colours, part) for name, part in animated.eyeballs.items()}
    named = {"head": rows.tolist()} | {name: part.tolist() for name, part in animated.eyeballs.items()}
    parts |= {name: replace(eyeball, gaze=AHEAD).mesh() for name, eyeball in animated.added.items()}
    inner = {
        name: MovingPart(JAW if name in WITH_JAW else NECK, part, animated.inner.moves[name], weights)
        for name, part in animated.inner.parts.items()
    }
    turns = {name: turn_to(gaze) for name, gaze in animated.gazes.items() if name in parts}
    return with_pivots(glb, animated.pivots, parts, named if turning.any() else {}, inner, turns)


def _part(
    animated: AnimatedMesh,
    triangles: Int[np.ndarray, "g 3"],
    colours: UInt8[np.ndarray, "t 3"],
    rows: Int[np.ndarray, " r"],
) -> Mesh:
    number = np.full(len(animated.neutral), -1)
    number[rows] = np.arange(len(rows))
    inside = triangles[(number[triangles] >= 0).all(axis=1)]
    return Mesh(animated.neutral[rows], number[inside].astype(np.int32), colours[rows])


def _inner_arrays(animated: AnimatedMesh) -> dict[str, Any]:
    """Returns teeth and tongue as one mesh; ``inner_parts`` says of each vertex which part it belongs to."""
    inner, vertices, faces, numbers, moves = animated.inner, [], [], [], []
    for number, (name, part) in enumerate(inner.parts.items()):
        faces.append(part.faces + sum(len(each) for each in vertices))
        vertices.append(part.vertices)
        numbers.append(np.full(len(part.vertices), number, np.uint8))
        still = np.zeros_like(part.vertices)
        moves.append(np.stack([inner.moves[name].get(shape, still) for shape in animated.shapes]))
    if not vertices:
        return {}
    return {
        "inner_vertices": np.concatenate(vertices).astype(np.float32),
        "inner_triangles": np.concatenate(faces).astype(np.int32),
        "inner_parts": np.concatenate(numbers),
        "inner_displacements": np.concatenate(moves, axis=1).astype(np.float32),
    }


def _archive(animated: AnimatedMesh, template: Template, blendshape_rig: BlendshapeRig) -> bytes:
    moved = {name for moves in animated.inner.moves.values() for name in moves}
    meta = {
        "format": FORMAT,
        "template": template.name,
        "template_sha256": template.source_sha256,
        "frame": "head",
        "unit": "mm",
        "names": list(animated.shapes),
        "weights": dict(blendshape_rig.weights),
        "without_counterpart": [name for name in blendshape_rig.missing if name not in moved],
        "visemes": {name: dict(mixture) for name, mixture in VISEMES.items()},
        "pivots": {name: pivot.tolist() for name, pivot in animated.pivots.items()},
        "eyeballs": {
            name: {"radius_mm": eyeball.radius_mm, "gaze": eyeball.gaze.tolist()}
            for name, eyeball in animated.added.items()
        },
        "gazes": {name: gaze.tolist() for name, gaze in animated.gazes.items()},
        "inner_mouth": {"parts": list(animated.inner.parts), "absence": animated.inner.absence},
    }
    packed = io.BytesIO()
    np.savez_compressed(
        packed,
        meta=np.frombuffer(json.dumps(meta, sort_keys=True).encode(), np.uint8),
        neutral=animated.neutral.astype(np.float32),
        displacements=np.stack(list(animated.shapes.values())).astype(np.float32),
        triangles=template.mesh.triangles().astype(np.int32),
        **_inner_arrays(animated),
    )
    return packed.getvalue()
