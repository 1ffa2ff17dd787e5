"""Runs whole jobs of the default level on pictures with faults that occur in studios: strands of hair across the
outline in every view, a hand before the face in one, a person behind the subject in one, an operator's mask in the
wrong position in one, one camera half a pixel off.

The result must have no spike (surface that the file calls seen, far from anything real), no hole, and no error of the
face without a warning.
"""

from collections.abc import Callable, Mapping
from dataclasses import replace
from pathlib import Path

import cv2
import numpy as np
from jaxtyping import Bool, Float
from scipy.spatial import KDTree

from pipeline.head_model.model import HeadModel
from pipeline.reconstruct import reconstruct
from pipeline.results.overlays import clay
from pipeline.settings import Settings
from pipeline.stages.context import ReconstructionContext
from rig.camera import Camera
from rig.capture import Capture, ImageRgb
from rig.errors import EigenheadError
from rig.formats.pictures.images import write_image
from rig.mesh import Mesh, boundary_edges
from rig.render.renderer import Renderer
from rig.rig import Rig
from tests.laboratory.experiments.paper.detail import IN_SPAN_MODES, IN_SPAN_SPREAD, Known, photographed, surface_error
from tests.laboratory.experiments.pictures import labelled
from tests.laboratory.experiments.records import Bench, Outcome, Row, key_of, means_by
from tests.laboratory.experiments.surface.visible import seen_of
from tests.laboratory.experiments.surface.visible_surface import score_visible

HIT = "cam03"  # the camera that suffers where one does
STRANDS, STRAND_MM, STRAND_TURN = 40, 70.0, 0.9  # a view; their length, and how far (rad) they may lean
OFF_PX = 0.5
SPIKE_MM = 5.0  # seen surface farther from what two cameras see: hair's own roughness stays below
SEED = 400


def planted(model: HeadModel, *, renderer: Renderer, bench: Bench, subjects: int = 2) -> Outcome:
    """Runs this module's experiment. Returns ``{"figures": {...}, "rows": [...]}``. A figure is ``<fault>_<quantity>``,
    the mean over the subjects whose job had a result; ``refused`` is the share of those without one.

    Args:
        model: fitted; heads are drawn from it, too.
        renderer: for the studio.
        subjects: number of heads, each with every fault.
    """
    records = bench.records("planted", key_of(model.sha256, Settings()))
    rows = []
    for number in range(subjects):
        known = photographed(model, IN_SPAN_MODES, IN_SPAN_SPREAD, SEED + number, renderer=renderer)
        for done, (kind, plant) in enumerate(PLANTS.items()):
            bench.report(f"{number} {kind}", (number + done / len(PLANTS)) / subjects)
            rng = np.random.default_rng((SEED, number))
            spoilt = plant(known, rng)
            picture = None if bench.folder is None else bench.folder / f"planted-{number}-{kind}.jpg"
            row = records.row(f"{number} {kind}", lambda s=spoilt, p=picture: planted_row(s, model, renderer, p))
            rows.append({"subject": number, "fault": kind, **row})
    return {"figures": means_by(rows, "fault"), "rows": rows}


def planted_row(known: Known, model: HeadModel, renderer: Renderer, picture: Path | None) -> Row:
    """Runs one job. Returns why it was refused, or the errors of its result."""
    try:
        found = reconstruct(ReconstructionContext(known.capture, known.rig, model, Settings(), renderer))
    except EigenheadError as error:
        return {"refused": 1.0, "why": f"{type(error).__name__}: {error}"}
    warnings = sorted({warning.code for warning in found.warnings})
    row: Row = {"refused": 0.0, "warnings": warnings}
    row |= {f"face_{key}": value for key, value in surface_error(known, found.mesh_world).items()}
    if found.bust is None:
        return row | {"bust": 0.0}
    bust = found.bust.surface.mesh_world
    seen = seen_of(found.bust.surface)
    off = KDTree(known.visible.points).query(seen.vertices[np.unique(seen.faces)])[0]
    if picture is not None:
        in_head = found.head.fit.world_from_head.inverse()
        views = [(bust, "bust.ply"), (found.mesh_world, "head.ply")]
        clays = [labelled(clay(Mesh(in_head.apply(m.vertices), m.faces), azimuth_deg=30.0), name) for m, name in views]
        write_image(picture, np.hstack(clays))
    return row | {
        "bust": 1.0,
        "open_edges": float(len(boundary_edges(bust.faces))),
        "recall_within_2mm": score_visible(known.visible, bust).recall["all"]["within_2mm"],
        "spikes_share": float((off > SPIKE_MM).mean()),
        "farthest_mm": float(off.max()),
    }


def strands(known: Known, rng: np.random.Generator) -> Known:
    """Plants loose hair that stands off the head, with other strands in every view: thinner than a mask can follow."""
    images = {}
    for camera in known.rig:
        image, mask = known.capture.images[camera.name].copy(), subject_mask(known, camera)
        around = mask ^ cv2.erode(mask.astype(np.uint8), np.ones((3, 3), np.uint8)).astype(bool)
        rows, columns = np.nonzero(around)
        upper = rows < np.median(rows)  # above the shoulders
        centre = np.array([columns[upper].mean(), rows[upper].mean()])
        for k in rng.choice(np.flatnonzero(upper), STRANDS):
            root = np.array([columns[k], rows[k]], float)
            out = np.arctan2(*(root - centre)[::-1])
            tip = STRAND_MM * rng.uniform(0.3, 1.0) * px_per_mm(known, camera)
            ways = out + np.linspace(0.0, rng.uniform(-STRAND_TURN, STRAND_TURN), 12)
            path = root + np.cumsum(np.stack([np.cos(ways), np.sin(ways)], axis=1), axis=0) * tip / 12
            inside = root - 3 * np.array([np.cos(out), np.sin(out)])
            column, row = np.clip(inside, 0, np.array(mask.shape[::-1]) - 1).astype(int)
            _line(image, np.vstack([root, path]), 1, image[row, column])
        images[camera.name] = image
    return replace(known, capture=replace(known.capture, images=images))


def hand(known: Known, rng: np.random.Generator) -> Known:
    """Plants a hand that reaches between one camera and the face."""
    camera = known.rig[HIT]
    image, scale = known.capture.images[HIT].copy(), px_per_mm(known, camera)
    face = camera.project(known.mesh.vertices[known.face])
    low, high = face.min(axis=0), face.max(axis=0)
    palm = np.array([high[0], 0.5 * low[1] + 0.5 * high[1]]) + rng.uniform(-10, 10, 2) * scale
    skin = np.median(image[tuple(np.clip(face.astype(int), 0, np.array(image.shape[1::-1]) - 1).T[::-1])], axis=0)
    _line(image, np.array([palm, palm + scale * np.array([400.0, 60.0])]), round(70 * scale), skin)
    cv2.circle(image, (round(palm[0]), round(palm[1])), round(42 * scale), skin.tolist(), -1, cv2.LINE_AA)
    for k in range(4):
        tip = palm + scale * np.array([-95.0 + 8 * abs(k - 1.5), -38.0 + 25.0 * k])
        _line(image, np.array([palm + scale * np.array([0.0, -30.0 + 20.0 * k]), tip]), round(17 * scale), 0.93 * skin)
    return _with_image(known, HIT, image)


def behind(known: Known, rng: np.random.Generator) -> Known:
    """Plants a person who stands behind the subject, visible to one camera."""
    camera = known.rig[HIT]
    image, mask, scale = known.capture.images[HIT].copy(), subject_mask(known, camera), px_per_mm(known, camera)
    columns = np.nonzero(mask.any(axis=0))[0]
    middle = np.array([columns[-1] - 20 * scale, 0.45 * mask.shape[0]])
    person = image.copy()
    for down, sides, colour in ((330.0, (190, 240), rng.uniform(60, 110, 3)), (0.0, (72, 100), (188, 143, 120))):
        place, axes = middle + scale * np.array([0.0, down]), scale * np.array(sides)
        cv2.ellipse(person, [*map(round, place)], [*map(round, axes)], 0, 0, 360, [*colour], -1, cv2.LINE_AA)
    image[~mask] = cv2.GaussianBlur(person, (0, 0), 1.0)[~mask]
    return _with_image(known, HIT, image)


def wrong_mask(known: Known, rng: np.random.Generator) -> Known:
    """Plants an operator's mask of one view that lies a finger's breadth off."""
    camera = known.rig[HIT]
    shift = round(25 * px_per_mm(known, camera))
    mask = np.roll(subject_mask(known, camera), shift, axis=1)
    mask[:, :shift] = False
    return replace(known, capture=replace(known.capture, masks={HIT: mask}))


def half_a_pixel_off(known: Known, rng: np.random.Generator) -> Known:
    """Turns one camera after calibration by an angle too small to notice."""
    camera = known.rig[HIT]
    turned = camera.moved(np.array([0.0, OFF_PX / camera.intrinsics.fx, 0.0, 0.0, 0.0, 0.0]))
    return replace(known, rig=Rig(tuple(turned if c.name == HIT else c for c in known.rig)))


PLANTS: Mapping[str, Callable[[Known, np.random.Generator], Known]] = {
    "nothing": lambda known, rng: known,
    "strands": strands,
    "hand": hand,
    "behind": behind,
    "wrong-mask": wrong_mask,
    "half-a-pixel-off": half_a_pixel_off,
}


def subject_mask(known: Known, camera: Camera) -> Bool[np.ndarray, "h w"]:
    """Returns an approximate mask of the subject: what two cameras see of it, with gaps closed."""
    height, width = known.capture.images[camera.name].shape[:2]
    drawn = np.zeros((height, width), np.uint8)
    radius = max(2, round(2.0 * px_per_mm(known, camera)))
    for x, y in np.round(camera.project(known.visible.points.astype(float))).astype(int):
        cv2.circle(drawn, (int(x), int(y)), radius, 1, -1)
    closed = cv2.morphologyEx(drawn, cv2.MORPH_CLOSE, np.ones((8 * radius + 1,) * 2, np.uint8))
    rings = cv2.findContours(closed, cv2.RETR_EXTERNAL, cv2.CHAIN_APPROX_NONE)[0]
    cv2.drawContours(closed, [max(rings, key=cv2.contourArea)], -1, 1, -1)
    return closed.astype(bool)


def px_per_mm(known: Known, camera: Camera) -> float:
    """Returns how many pixels a millimetre in the middle of the head covers in a camera."""
    depth = camera.camera_from_world.apply(known.mesh.vertices.mean(axis=0))[2]
    return float(camera.intrinsics.fx / depth)


def _line(image: ImageRgb, path: Float[np.ndarray, "n 2"], thickness: int, colour: np.ndarray) -> None:
    points = np.round(path * 8).astype(np.int32)[None]
    cv2.polylines(image, [*points], False, np.asarray(colour, float).tolist(), thickness, cv2.LINE_AA, shift=3)


def _with_image(known: Known, name: str, image: ImageRgb) -> Known:
    capture: Capture = replace(known.capture, images={**known.capture.images, name: image})
    return replace(known, capture=capture)
