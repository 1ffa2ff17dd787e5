"""Measures how well the albedo removes light: one subject in three lights, as textures and as albedos.

Compared are texels of the face that all three captures show, by CIEDE2000, for each pair of lights: head.glb's texture
against texture/albedo.png. ``_level`` is the same after each image's overall colour is brought to the first one's (the
median by channel, in linear light): what remains is shading and shadow. The heads are fitted anew for each light, so
that both figures contain the differences of the fits and of the cameras' noise; ``floor`` is that part, from the same
light shot twice. ``chart_...`` is the same with a colour chart in one clean plate of each camera.
"""

from collections.abc import Mapping
from dataclasses import replace
from functools import partial
from itertools import combinations
from pathlib import Path

import cv2
import numpy as np
from jaxtyping import UInt8

from pipeline.geometry.projection import depth_map
from pipeline.head_model.model import HeadModel
from pipeline.imaging import colour_chart
from pipeline.imaging.masks import box_around
from pipeline.reconstruct import reconstruct
from pipeline.results.reconstruction import Reconstruction
from pipeline.settings import OutputSettings, Settings
from pipeline.stages.context import ReconstructionContext
from pipeline.texturing import albedo, chart_colours, visibility
from pipeline.texturing import light as fitted_light
from pipeline.texturing.albedo import Albedo
from rig.capture import Capture
from rig.colour_space import linear_from_srgb, srgb_from_linear
from rig.errors import EigenheadError
from rig.formats.pictures.images import write_image
from rig.mesh import Mesh
from rig.render.renderer import Renderer
from rig.rig import Rig
from rig.studio.scene.layout import default_layout
from rig.studio.scene.lights import LAMPS, Lamp
from rig.studio.scene.simulate import Scene, build_scene, shoot
from rig.studio.scene.subject import Subject
from rig.studio.sensor.preset import PRESET
from tests.laboratory.experiments.paper.detail import IN_SPAN_MODES, IN_SPAN_SPREAD
from tests.laboratory.experiments.pictures import labelled
from tests.laboratory.experiments.records import Bench, Outcome, Row, key_of
from tests.laboratory.experiments.surface.texture import drawn_texture
from tests.support.colour_chart_pictures import chart_plate
from tests.support.colour_difference import difference_2000, lab_from_srgb
from tests.support.face_texels import face_texels, texels

Image = UInt8[np.ndarray, "s s 3"]
SUBJECTS = 1
PANEL = (540, 780)
MIN_FACING = 0.3  # cosine: flatter, the patches of a chart run together
LIGHTS: Mapping[str, tuple[Lamp, ...]] = {
    "studio": LAMPS,
    "left": (  # a warm window on the subject's left, hardly a fill
        Lamp((0.90, 0.25, 0.55), (1.55, 1.35, 1.10), 7.0),
        Lamp((-0.80, 0.30, 0.60), (0.28, 0.31, 0.36), 5.0),
        Lamp((0.0, 1.0, -0.25), (0.25, 0.25, 0.26), 5.0),
    ),
    "overhead": (  # daylight from the ceiling, a little from the front
        Lamp((0.05, 1.0, 0.35), (1.45, 1.52, 1.62), 7.0),
        Lamp((0.0, 0.1, 1.0), (0.50, 0.50, 0.50), 5.0),
    ),
}


def light(model: HeadModel, *, renderer: Renderer, bench: Bench, subjects: int = SUBJECTS) -> Outcome:
    """Runs this module's experiment. Returns ``{"figures": {...}, "rows": [...]}``: means over subjects and pairs of
    lights, and a row for each subject.

    ``model``: fitted; heads are drawn from it, too. ``renderer``: for the studio. ``subjects``: heads in the studio.
    """
    settings = replace(Settings(), outputs=OutputSettings(surface="head", albedo="file", texture_size=2048))
    code = (fitted_light, albedo, visibility, chart_colours, colour_chart)
    records = bench.records("light", key_of(model.sha256, settings, LIGHTS, *code))
    rows = []
    for number in range(subjects):
        name = f"{number:02}"
        picture = None if bench.folder is None else bench.folder / f"light-{name}.png"
        compute = partial(row_of, model, 400 + number, renderer, settings, picture)
        rows.append({"name": name, **records.row(name, compute, number / subjects)})
    keys = [key for key, value in rows[0].items() if isinstance(value, float)]
    return {"figures": {key: float(np.mean([row[key] for row in rows])) for key in keys}, "rows": rows}


def row_of(model: HeadModel, seed: int, renderer: Renderer, settings: Settings, picture: Path | None) -> Row:
    """Runs one subject in every light, and in the first one twice; all of it again with a colour chart."""
    rig = default_layout()
    found = {name: lit_head(model, seed, rig, lamps, renderer, settings) for name, lamps in LIGHTS.items()}
    again = lit_head(model, seed, rig, LAMPS, renderer, settings, shot=1)
    row = differences(model, found, again)
    if picture is not None:
        write_image(picture, sheet(found, rig))
    charted = replace(settings, texture=replace(settings.texture, chart=True))
    found = {name: lit_head(model, seed, rig, lamps, renderer, charted) for name, lamps in LIGHTS.items()}
    again = lit_head(model, seed, rig, LAMPS, renderer, charted, shot=1)
    row |= {f"chart_{key}": value for key, value in differences(model, found, again).items()}
    if picture is not None:
        write_image(picture.with_stem(f"{picture.stem}-chart"), sheet(found, rig))
    return row | {"chart_ratio_to_plain_texture": row["chart_albedo"] / row["texture"]}


def differences(model: HeadModel, found: Mapping[str, Reconstruction], again: Reconstruction) -> Row:
    """Returns the figures of textures and albedos, as means over the pairs of lights. ``again`` is the second shot in
    the first light."""
    every = [*found.values(), again]
    layout = albedo_of(every[0]).atlas.layout
    seen = (
        np.asarray(np.all([head.texturing.vertices.views > 0 for head in every], axis=0))
        & model.levels["full"].face_region
    )
    face = face_texels(layout, seen)
    textures = {name: texels(_texture(head), face) for name, head in found.items()}
    albedos = {name: texels(albedo_of(head).atlas.image, face) for name, head in found.items()}
    row: Row = {"texels": int(face.sum())}
    for kind, images, second in (
        ("texture", textures, texels(_texture(again), face)),
        ("albedo", albedos, texels(albedo_of(again).atlas.image, face)),
    ):
        row |= {f"{kind}_floor": _difference(images["studio"], second)}
        for suffix, change in (("", lambda codes, to: codes), ("_level", levelled)):
            pairs = {
                f"{a}_{b}": _difference(images[a], change(images[b], images[a])) for a, b in combinations(LIGHTS, 2)
            }
            row |= {f"{kind}{suffix}_{key}": value for key, value in pairs.items()}
            row |= {f"{kind}{suffix}": float(np.mean(list(pairs.values())))}
    return row | {f"ratio{suffix}": row[f"albedo{suffix}"] / row[f"texture{suffix}"] for suffix in ("", "_level")}


def lit_head(
    model: HeadModel,
    seed: int,
    rig: Rig,
    lamps: tuple[Lamp, ...],
    renderer: Renderer,
    settings: Settings,
    *,
    shot: int = 0,
) -> Reconstruction:
    """Reconstructs the head of ``seed`` in one light. Look and pose are the same in every light; the noise is not."""
    coefficients = IN_SPAN_SPREAD * np.random.default_rng((9, seed)).standard_normal(IN_SPAN_MODES)
    level = model.levels["full"]
    head = Mesh(model.vertices(coefficients), level.faces)
    marks = {name: head.vertices[row] for name, row in model.landmarks.items()}
    subject = Subject(head, marks, level.face_region, f"seed-{seed}")
    scene = build_scene(subject, rig, PRESET, np.random.default_rng((10, seed)), renderer=renderer, lamps=lamps)
    noise = np.random.default_rng((11, seed, shot, *(round(100 * lamp.towards[0]) % 256 for lamp in lamps)))
    capture = shoot(scene, noise)
    if settings.texture.chart:
        capture = with_chart_plates(capture, scene, lamps, noise)
    return reconstruct(ReconstructionContext(capture, rig, model, settings, renderer))


def with_chart_plates(capture: Capture, scene: Scene, lamps: tuple[Lamp, ...], rng: np.random.Generator) -> Capture:
    """Adds a clean plate with a colour chart, held towards the front camera, for every camera that can see it."""
    front, middle = scene.rig.front_camera(), scene.world_from_head.translation
    towards = {camera.name: camera.centre_world - middle for camera in scene.rig}
    facing = {
        name: way @ towards[front] / np.linalg.norm(way) / np.linalg.norm(towards[front])
        for name, way in towards.items()
    }
    plates = dict(capture.backgrounds)
    for name in scene.rig.names:
        if facing[name] > MIN_FACING:
            chart = chart_plate(scene, name, colour_chart.true_colours(), rng, turned_to=front, lamps=lamps)
            plates[name] = (*plates[name], chart)
    return replace(capture, backgrounds=plates)


def levelled(codes: UInt8[np.ndarray, "n 3"], to: UInt8[np.ndarray, "n 3"]) -> UInt8[np.ndarray, "n 3"]:
    """Returns ``codes`` scaled so that the median of each channel is that of ``to``, in linear light."""
    ours, theirs = linear_from_srgb(codes / 255.0), linear_from_srgb(to / 255.0)
    ratio = np.median(theirs, axis=0) / np.maximum(np.median(ours, axis=0), 1e-4)
    return np.rint(255 * srgb_from_linear(ours * ratio)).astype(np.uint8)


def _difference(one: UInt8[np.ndarray, "n 3"], other: UInt8[np.ndarray, "n 3"]) -> float:
    return float(difference_2000(lab_from_srgb(one), lab_from_srgb(other)).mean())


def _texture(head: Reconstruction) -> Image:
    if head.texturing.atlas is None:
        raise EigenheadError("a capture of the studio has no texture")
    return head.texturing.atlas.image


def albedo_of(head: Reconstruction) -> Albedo:
    """Returns the albedo image of a head. Raises EigenheadError if it has none."""
    if head.texturing.albedo is None:
        raise EigenheadError("a capture of the studio has no albedo: " + "; ".join(w.text for w in head.warnings))
    return head.texturing.albedo


def sheet(found: Mapping[str, Reconstruction], rig: Rig) -> Image:
    """Draws a column for each light: the texture above, the albedo below, as the front camera would see them unlit."""
    camera = rig[rig.front_camera()]
    columns = []
    for name, head in found.items():
        mesh, albedo = head.mesh_world, albedo_of(head).atlas
        inside = np.isfinite(depth_map(camera, mesh.vertices, mesh.faces)[0])
        panels = []
        for kind, image in (("texture", _texture(head)), ("albedo", albedo.image)):
            drawn = np.clip(np.rint(drawn_texture(camera, mesh, albedo.layout, image)), 0, 255)
            panel = np.where(inside[:, :, None], drawn, 255).astype(np.uint8)[box_around(inside, 0)]
            panels.append(labelled(np.asarray(cv2.resize(panel, PANEL)), f"{name}: {kind}"))
        columns.append(np.vstack(panels))
    return np.hstack(columns)
