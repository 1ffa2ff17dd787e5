"""Writes the files that applications add to a job's result. ``head-NAME.glb`` and ``head-NAME-shapes.npz`` hold the
template's mesh without expression and its blendshapes. ``posed.glb`` holds the model's textured mesh and blendshapes.

The GLB files are in the head frame in metres, the NPZ file in the head frame in mm. Vertices keep the order of the
template or of the head model. In a GLB file, eyeballs are separate nodes, and a node's ``extras.rows`` lists the
indices of its vertices in the mesh. Eyeballs, teeth and tongue that this program added have no ``rows``. For the
formats OBJ and USDZ, ``head-NAME-parts.obj`` and ``head-NAME-parts.usdz`` hold the template's named parts without
blendshapes.

The image of an eyeball is centred at the iris; distance from its centre is proportional to the angle from the gaze.
Between the lids, an eyeball's image shows the head's texture, elsewhere median colours of iris or white."""

import io
import json
from collections.abc import Mapping
from dataclasses import dataclass, replace
from functools import partial
from pathlib import Path
from typing import Any

import cv2
import numpy as np
from jaxtyping import Bool, Float, Int, UInt8

from pipeline.applications.templates.animated import AnimatedMesh, animate_head, animate_mesh
from pipeline.applications.templates.eyeballs import AHEAD, LIMBUS_MM, Eyeball, turn_to
from pipeline.applications.templates.flame_model import FlameFit, fit_flame
from pipeline.applications.templates.inner_mouth import TONGUE_OUT, WITH_JAW
from pipeline.applications.templates.template_file import Template, load_template
from pipeline.applications.templates.write.mesh import template_colours, write_template, write_template_hair
from pipeline.evidence.expression import BlendshapeRig
from pipeline.faces.irises import Iris, UnseenEye
from pipeline.geometry.surface_index import SurfaceIndex
from pipeline.head_model.expressions import VISEMES
from pipeline.head_model.model import HeadModel
from pipeline.head_model.subdivision import opened_faces
from pipeline.results.head_files import encoded, head_from_world, head_mesh, head_skin
from pipeline.results.reconstruction import Reconstruction, asset_extras
from pipeline.results.report_types import AddedReport, TemplateReport
from pipeline.results.write import ResultWriter
from pipeline.texturing.layout.uv_unwrap import Atlas
from rig.files import write_atomically
from rig.formats.meshes.flame_param import FILE, encode_flame_param, flame_param
from rig.formats.meshes.glb import scene_glb_bytes
from rig.formats.meshes.polygon_obj import scene_obj_bytes
from rig.formats.meshes.scene import NECK, Part, Scene, Skin
from rig.formats.meshes.usdz import scene_usdz_bytes
from rig.geometry import RigidTransform
from rig.mesh import Mesh

SIZE_PX = 512  # a texel is 0.15 mm, about a pixel of a photograph
FRONT_DEG = 75.0  # from the gaze: lids hide what is farther
ASIDE_MM = 0.5  # between a point of the ball and the nearest one between the lids, along the ball: more is hidden
FEATHER_PX = 6  # over which photographed colours fade to guessed ones
RING_DEG = 1.0
MIN_SEEN = 0.3  # of the iris
BRIGHT = 0.7  # of what is seen beside the iris, the share that lids and their shadow may be
DARK_SHARES, DARK = (0.2, 0.9), 0.5  # of what is seen, and of its brightness: a pupil and an iris beside the white
FORMAT = "eigenhead-shapes/1"
JAW = "jaw"
LID_MM = 30.0  # from an eyeball's middle: no other opening is so near


@dataclass(frozen=True, slots=True, eq=False)
class PhotographedEyes:
    """Holds the head as photographed (head frame, mm), the indices of its triangles between lids and between lips, and
    its texture, if it has one."""

    head: Mesh
    between: Int[np.ndarray, " g"]
    atlas: Atlas | None


def eyeball_uv(eyeball: Eyeball, mesh: Mesh) -> Float[np.ndarray, "n 2"]:
    """Returns the image coordinates of the vertices of an eyeball whose gaze is straight ahead."""
    away = mesh.vertices - eyeball.centre
    angle = np.arctan2(np.hypot(away[:, 0], away[:, 1]), away[:, 2])
    aside = np.hypot(away[:, 0], away[:, 1])
    along = np.where(aside[:, None] > 1e-9, away[:, :2] / np.maximum(aside, 1e-9)[:, None], (1.0, 0.0))
    return 0.5 + 0.5 * (angle / np.pi)[:, None] * along * (1.0, -1.0)


def paint_eyeball(eyeball: Eyeball, photographed: PhotographedEyes) -> UInt8[np.ndarray, "s s 3"] | None:
    """Returns the image of an eyeball (sRGB), or None if too little of its iris is visible."""
    angle, front, directions = _front(eyeball.gaze)
    colours, seen = _photographed(eyeball, directions, photographed)
    iris = angle[front] < np.arcsin(LIMBUS_MM / eyeball.radius_mm)
    if seen[iris].mean() < MIN_SEEN or not seen[~iris].any():
        return None
    ring = (np.degrees(angle[front]) / RING_DEG).astype(int)
    beside, light = seen & ~iris, colours.mean(axis=1)
    white = np.median(colours[beside & (light >= np.quantile(light[beside], BRIGHT))], axis=0)
    guess = np.tile(white, (len(ring), 1))
    for number in np.unique(ring[iris]):
        rows = ring == number
        guess[rows] = np.median(colours[rows & seen], axis=0) if (rows & seen).any() else white
    shown = np.zeros(angle.shape, np.uint8)
    shown[front] = seen
    share = np.minimum(cv2.distanceTransform(shown, cv2.DIST_L2, 5) / FEATHER_PX, 1.0)[front][:, None]
    image = np.tile(white, (SIZE_PX, SIZE_PX, 1))
    image[front] = share * colours + (1.0 - share) * guess
    return np.clip(np.rint(image), 0, 255).astype(np.uint8)


def darkest_direction(eyeball: Eyeball, photographed: PhotographedEyes) -> Float[np.ndarray, " 3"] | None:
    """Returns the direction (unit vector) from the eyeball's centre to the middle of the darkest area between the lids,
    usually the iris; None if no area is much darker than the rest, as between closed lids."""
    _, _, directions = _front(eyeball.gaze)
    colours, seen = _photographed(eyeball, directions, photographed)
    if not seen.any():
        return None
    light = colours[seen].mean(axis=1)
    dark, bright = np.quantile(light, DARK_SHARES)
    towards = directions[seen][light < dark].mean(axis=0) if dark < DARK * bright else None
    return None if towards is None else towards / np.linalg.norm(towards)


def _front(
    gaze: Float[np.ndarray, " 3"],
) -> tuple[Float[np.ndarray, "s s"], Bool[np.ndarray, "s s"], Float[np.ndarray, "n 3"]]:
    """Returns, for each texel of an eyeball's image, the angle from the gaze (rad) and whether it is on the front half;
    also the directions of these texels."""
    offsets = (np.arange(SIZE_PX) + 0.5) / SIZE_PX - 0.5
    x, y = np.meshgrid(offsets, -offsets)
    angle = 2.0 * np.pi * np.hypot(x, y)
    front = angle < np.radians(FRONT_DEG)
    ahead = np.sinc(angle[front] / np.pi)[:, None] * 2.0 * np.pi * np.stack([x[front], y[front]], axis=1)
    return angle, front, np.column_stack([ahead, np.cos(angle[front])]) @ turn_to(gaze).T


def _photographed(
    eyeball: Eyeball, directions: Float[np.ndarray, "n 3"], photographed: PhotographedEyes
) -> tuple[Float[np.ndarray, "n 3"], Bool[np.ndarray, " n"]]:
    """Returns photographed colours (sRGB) in directions from an eyeball's centre, and which directions no lid hides."""
    head, atlas = photographed.head, photographed.atlas
    if atlas is None or not len(photographed.between):
        return np.zeros_like(directions), np.zeros(len(directions), bool)
    layout, image = atlas.layout, atlas.image
    points = eyeball.centre + eyeball.reach(directions)[:, None] * directions
    hits = SurfaceIndex(head.vertices, head.faces[photographed.between]).closest(points)
    off = hits.points - points
    aside = off - np.einsum("nx,nx->n", off, directions)[:, None] * directions
    corners = layout.uv[layout.faces[photographed.between[hits.triangles]]]
    texels = (np.einsum("nk,nkx->nx", hits.weights, corners) * len(image) - 0.5).astype(np.float32)
    rows = np.resize(texels, (-(-len(texels) // SIZE_PX), SIZE_PX, 2))  # remap takes no more than 32,767 in a row
    colours = cv2.remap(image, rows[..., 0], rows[..., 1], cv2.INTER_LINEAR, borderMode=cv2.BORDER_REPLICATE)
    return np.asarray(colours, float).reshape(-1, 3)[: len(texels)], np.linalg.norm(aside, axis=1) < ASIDE_MM


def load_template_writers(name: str | None, model: HeadModel) -> tuple[ResultWriter, ...]:
    """Loads the named template, if any, for a job with ``model``; returns the writers of posed.glb and template files.

    Raises UnknownTemplate, BadTemplate, OtherModel."""
    template = load_template(name, model)
    return (write_posed, *(() if template is None else template_writers(template)))


def template_writers(template: Template) -> tuple[ResultWriter, ...]:
    """Returns the functions with which ``write_result`` also writes files in the template's vertex order:

    - head-NAME.obj is written with its textures, and head_hair-NAME.obj if the result has hair.
    - head-NAME.glb and head-NAME-shapes.npz are written if the settings request morph targets.
    - flame_param.npz is written if the template was made from a FLAME model; report.json gets the entry ``template``.
    """
    writers = (write_flame, write_template, write_template_shapes, write_template_hair)
    return tuple(partial(write, template=template) for write in writers)


DEEP = 0.1  # how much a vertex off the skin counts


def write_flame(folder: Path, result: Reconstruction, template: Template) -> AddedReport:
    """Fits the template's FLAME model, if it has one, to the head and writes FLAME's parameters. Returns the template's
    entry in report.json, with figures of this fit. Raises OSError."""
    report: TemplateReport = {
        "name": template.name,
        "source": template.source,
        "sha256": template.source_sha256,
        "registration": dict(template.figures),
    }
    if template.flame is None:
        return {"template": report}
    head, skin = result.mesh_world, template.surface_binding.skin
    weights = np.full(len(template.surface_binding.rest), DEEP)
    weights[skin] = 1.0
    fit = fit_flame(template.flame, template.surface_binding.on(head.vertices, head.faces) / 1000.0, weights)
    of = fit.parameters
    file = flame_param(of.shape, of.expression, of.pose, of.translation, fit.offsets)
    write_atomically(folder / FILE, encode_flame_param(file))
    report["flame"] = _flame_figures(fit, skin)
    return {"template": report}


def _flame_figures(fit: FlameFit, skin: np.ndarray) -> dict[str, float]:
    """Returns the distance (mm) between the fitted FLAME skin and the head without ``static_offset``, and the distance
    of the FLAME parameters from the mean (RMS, in standard deviations)."""
    off_mm = 1000.0 * fit.distances[skin]
    return {
        "residual_median_mm": float(np.median(off_mm)),
        "residual_p95_mm": float(np.percentile(off_mm, 95)),
        "shape_sigmas": float(np.sqrt((fit.parameters.shape**2).mean())),
        "expression_sigmas": float(np.sqrt((fit.parameters.expression**2).mean())),
    }


def write_template_shapes(folder: Path, result: Reconstruction, template: Template) -> None:
    """Writes the template's mesh with morph targets and pivots as GLB and as arrays, if the settings request morph
    targets and the head model has blendshapes. Raises OSError."""
    blendshape_rig = result.evidence.blendshape_rig
    if blendshape_rig is None or not result.settings.outputs.morphs:
        return
    from_world = head_from_world(result)
    triangles, colours = template.mesh.triangles(), template_colours(result, template)
    animated = animate_mesh(
        template.surface_binding,
        triangles,
        from_world.apply(blendshape_rig.neutral_world.vertices),
        blendshape_rig.neutral_world.faces,
        blendshape_rig.morphs,
        result.head.model.landmarks,
        gazes=_gazes(result.faces.eyes, from_world),
    )
    name = f"head-{template.name}"
    extras = asset_extras(result) | {"template": template.name, "template_sha256": template.source_sha256}
    extras |= {"inner_mouth": animated.inner.absence or "added"}
    scene = animated_scene(animated, triangles, colours, blendshape_rig.weights)
    write_atomically(folder / f"{name}.glb", scene_glb_bytes(scene, extras))
    write_atomically(folder / f"{name}-shapes.npz", _archive(animated, template, blendshape_rig))
    for suffix, encode in (("obj", scene_obj_bytes), ("usdz", scene_usdz_bytes)):
        if suffix in result.settings.outputs.formats:
            write_atomically(folder / f"{name}-parts.{suffix}", encode(scene))


def write_posed(folder: Path, result: Reconstruction) -> None:
    """Writes posed.glb if the settings request morph targets and the head model has blendshapes. The file holds a head
    without expression, texture, blendshapes, pivots, eyeballs, teeth, tongue, and the photographed weights. Raises
    OSError."""
    blendshape_rig = result.evidence.blendshape_rig
    if blendshape_rig is None or not result.settings.outputs.morphs:
        return
    model, from_world, head = result.head.model, head_from_world(result), head_mesh(result)
    opened = opened_faces({name: model.levels[name].faces for name in ("cage", "full")})
    neutral, eyes = from_world.apply(blendshape_rig.neutral_world.vertices), result.faces.eyes
    shapes = blendshape_rig.moving
    animated = AnimatedMesh(neutral, shapes, {}, {})
    if len(opened) < len(head.faces):
        animated = animate_head(neutral, opened, shapes, model.landmarks, gazes=_gazes(eyes, from_world))
    photographed = PhotographedEyes(head, np.arange(len(opened), len(head.faces)), result.texturing.atlas)
    animated = replace(animated, gazes=_towards_irises(animated, eyes, from_world, photographed))
    skin, colours = head_skin(result, head), result.texturing.vertices.colours
    shut = {name: ball.centre for name, ball in animated.added.items() if _is_bridged(name, result)}
    middle = head.vertices[head.faces].mean(axis=1)
    kept = np.arange(len(head.faces)) < len(opened)
    for centre in shut.values():  # the strip between such lids is skin
        kept |= np.linalg.norm(middle - centre, axis=1) < LID_MM
    animated = replace(animated, added={name: ball for name, ball in animated.added.items() if name not in shut})
    if skin is not None and skin.faces is not None:
        skin = replace(skin, faces=skin.faces[kept])
    scene = animated_scene(animated, head.faces[kept], colours, blendshape_rig.weights, skin)
    scene = replace(scene, parts=[_with_picture(part, animated, photographed) for part in scene.parts])
    write_atomically(folder / "posed.glb", scene_glb_bytes(scene, asset_extras(result)))


def _is_bridged(pivot: str, result: Reconstruction) -> bool:
    """Returns whether an eye of the head was closed by a bridge between its lids instead of a blink expression."""
    side, found = pivot.removeprefix("eye_"), result.evidence.blendshape_rig
    eye, blink = result.faces.eyes.get(side), f"eyeBlink{side.title()}"
    return isinstance(eye, UnseenEye) and eye.cause == "closed" and not (found and found.weights.get(blink))


def _towards_irises(
    animated: AnimatedMesh,
    eyes: Mapping[str, Iris | UnseenEye],
    from_world: RigidTransform,
    photographed: PhotographedEyes,
) -> dict[str, Float[np.ndarray, " 3"]]:
    """Returns the directions from the centres of added eyeballs to the photographed irises. So turned, each iris lies
    where it was photographed. The darkest area between the open lids replaces an iris that was not measured."""
    found = {}
    for name, ball in animated.added.items():
        eye = eyes.get(name.removeprefix("eye_"))
        if isinstance(eye, Iris):
            towards = from_world.apply(eye.centre[None])[0] - ball.centre
            found[name] = towards / np.linalg.norm(towards)
        elif eye is not None and eye.cause != "closed":
            found[name] = darkest_direction(ball, photographed)
    return {name: gaze for name, gaze in found.items() if gaze is not None}


def _with_picture(part: Part, animated: AnimatedMesh, photographed: PhotographedEyes) -> Part:
    """Returns an added eyeball with its image if its iris is visible; returns other parts unchanged."""
    if part.name not in animated.added or part.name not in animated.gazes:
        return part
    ball = replace(animated.added[part.name], gaze=animated.gazes[part.name])
    image = paint_eyeball(ball, photographed)
    if image is None:
        return part
    return replace(part, skin=Skin(eyeball_uv(ball, part.mesh), encoded(image, "jpeg")))


def _gazes(eyes: Mapping[str, Iris | UnseenEye], from_world: RigidTransform) -> dict[str, Float[np.ndarray, " 3"]]:
    """Returns the gaze directions of measured eyes, by pivot (unit vectors, head frame)."""
    return {f"eye_{side}": from_world.rotation @ eye.gaze for side, eye in eyes.items() if isinstance(eye, Iris)}


def animated_scene(
    animated: AnimatedMesh,
    triangles: Int[np.ndarray, "g 3"],
    colours: UInt8[np.ndarray, "t 3"],
    weights: Mapping[str, float],
    skin: Skin | None = None,
) -> Scene:
    """Returns an animated mesh as named parts: the head with its shapes and ``skin``, eyeballs that rotate about their
    pivots, teeth and tongue."""
    turning = np.zeros(len(animated.neutral), bool)
    for rows in animated.eyeballs.values():
        turning[rows] = True
    rows = np.flatnonzero(~turning)
    named = {"head": rows, **animated.eyeballs} if turning.any() else {"head": None}
    morphs = {name: shape[rows] for name, shape in animated.shapes.items()}
    parts = []
    for name, of_mesh in named.items():
        mesh = _part(animated, triangles, colours, rows if of_mesh is None else of_mesh)
        listed = None if of_mesh is None else of_mesh.tolist()
        if name == "head":
            parts.append(Part(name, mesh, skin=skin, morphs=morphs, weights=weights, rows=listed))
        else:
            parts.append(Part(name, mesh, pivot=name, rows=listed))
    for name, eyeball in animated.added.items():
        parts.append(Part(name, replace(eyeball, gaze=AHEAD).mesh(), pivot=name))
    for name, mesh in animated.inner.parts.items():
        moves, pivot = animated.inner.moves[name], JAW if name in WITH_JAW else NECK
        wanted = {shape: move for shape, move in moves.items() if shape in animated.shapes or shape == TONGUE_OUT}
        parts.append(Part(name, mesh, morphs=wanted, weights=weights, pivot=pivot))
    return Scene(parts, animated.pivots, {name: turn_to(gaze) for name, gaze in animated.gazes.items()})


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
    """Returns teeth and tongue as one mesh; ``inner_parts`` holds the part to which each vertex belongs."""
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
