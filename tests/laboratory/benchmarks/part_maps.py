"""Parts of every pixel against the truth: accuracy by part, and seconds.

python -m tests.laboratory part_maps CAPTURE ... --styles long --styles curly,beard

CAPTURE is a folder with a truth beside it: parts/ (a simulated one) or visible.npz (points, of which those that a
camera sees are looked up). Each is reconstructed first, as the parts are told on the fitted head. ``--styles``
simulates a subject for each, seeds counted up from ``--first``. A pixel is given to a part with a probability beyond a
half.
"""

import time
from collections.abc import Iterator, Sequence
from dataclasses import replace
from pathlib import Path
from typing import Annotated, Any

import cv2
import numpy as np
from jaxtyping import UInt8

from pipeline.geometry.raster import camera_depths
from pipeline.head_model.model import HeadModel
from pipeline.part_labels.labelling import classify_parts
from pipeline.reconstruct import reconstruct
from pipeline.settings import PartSettings, Settings
from pipeline.stages.context import ReconstructionContext
from rig.camera import Camera
from rig.capture import Capture
from rig.formats.captures.capture_folder import read_capture
from rig.formats.pictures.images import read_image
from rig.progress import Progress
from rig.render.renderer import Renderer
from rig.rig import Rig
from rig.studio.scene.layout import default_layout
from rig.studio.scene.simulate import simulate
from rig.studio.sensor.preset import PRESET
from server.tasks.subjects import drawn_subject

PARTS = ("skin", "hair", "clothes")
SPLAT_PX, BEHIND_MM, LEAST_FACING = 4, 6.0, 0.15  # of true points: cells of a depth map, and what it hides

Shot = tuple[str, Capture, Rig, dict[str, UInt8[np.ndarray, "h w"]]]


def run(
    captures: Sequence[Path] = (),
    *,
    styles: Sequence[str] = (),
    first: Annotated[int, "seed of the first style"] = 0,
    model: HeadModel,
    renderer: Renderer,
    report: Progress,
) -> dict[str, Any]:
    """Returns recall and precision by part, for each capture and style."""
    found = {}
    for name, capture, rig, truth in shots(captures, styles, first, model, renderer):
        report(name, len(found) / (len(captures) + len(styles)))
        found[name] = measure(capture, rig, truth, model, renderer)
    return {"figures": found}


def shots(
    captures: Sequence[Path], styles: Sequence[str], first: int, model: HeadModel, renderer: Renderer
) -> Iterator[Shot]:
    """Captures with the true parts of their pixels: 1 skin, 2 hair, 3 clothes, 0 not known or background."""
    for folder in captures:
        capture, rig = read_capture(folder)
        truth = folder.with_name(folder.name + ".truth")
        if (truth / "parts").is_dir():
            parts = {name: read_image(truth / "parts" / f"{name}.png")[..., 0] for name in rig.names}
        else:
            points = np.load(truth / "visible.npz")
            parts = {camera.name: seen_parts(camera, points) for camera in rig}
        yield folder.name, capture, rig, parts
    for seed, style in enumerate(styles, first):
        rng = np.random.default_rng(seed)
        preset = replace(PRESET, hairstyle=tuple(style.split(",")))
        taken = simulate(drawn_subject(model, rng), default_layout(), preset, rng, renderer=renderer)
        yield f"{style} ({seed})", taken.capture, taken.rig, dict(taken.scene.parts)


def seen_parts(camera: Camera, truth: np.lib.npyio.NpzFile) -> UInt8[np.ndarray, "h w"]:
    """The true part at each pixel that a point falls on which nothing hides."""
    points, normals = truth["points"].astype(float), truth["normals"].astype(float)
    towards = camera.centre_world - points
    facing = (towards * normals).sum(axis=1) / np.linalg.norm(towards, axis=1)
    pixels, depth = camera.project(points), camera_depths(camera, points)
    k = camera.intrinsics
    framed = ((pixels >= 0) & (pixels < (k.width - 1, k.height - 1))).all(axis=1)
    column, row = np.rint(pixels[framed] / SPLAT_PX).astype(int).T
    nearest = np.full((k.height // SPLAT_PX + 2, k.width // SPLAT_PX + 2), 1e6, np.float32)
    np.minimum.at(nearest, (row, column), depth[framed].astype(np.float32))
    nearest = cv2.erode(nearest, np.ones((3, 3), np.uint8))
    kept = (depth[framed] < nearest[row, column] + BEHIND_MM) & (facing[framed] > LEAST_FACING)
    found = np.zeros((k.height, k.width), np.uint8)
    at = np.rint(pixels[framed][kept]).astype(int)
    found[at[:, 1], at[:, 0]] = truth["part"][framed][kept] + 1
    return found


def measure(
    capture: Capture, rig: Rig, truth: dict[str, UInt8[np.ndarray, "h w"]], model: HeadModel, renderer: Renderer
) -> dict[str, float]:
    """Recall and precision by part, over the pixels whose truth is known and that the masks hold."""
    done = reconstruct(ReconstructionContext(capture, rig, model, Settings(), renderer))
    landmarks = {name: point.position_mm for name, point in done.evidence.landmarks.items()}
    region = model.levels["full"].face_region
    images, silhouettes, head = capture.images, done.views.silhouettes, done.mesh_world
    settings, started = PartSettings(), time.process_time()
    maps = classify_parts(
        images, silhouettes, rig, head, region, landmarks, settings=settings, report=lambda stage, share: None
    )
    seconds = time.process_time() - started
    counts = np.zeros((4, 4))
    for name, found in maps.items():
        labels = np.where(found.probability.max(axis=2) > 0.5, 1 + found.probability.argmax(axis=2), 0)
        true = np.where(done.views.silhouettes[name].mask, truth[name], 0)
        counts += np.bincount((4 * true.astype(int) + labels).ravel(), minlength=16).reshape(4, 4)
    counts = counts[1:]
    row = {
        "right": sum(counts[i, i + 1] for i in range(3)) / counts.sum(),
        "unknown": counts[:, 0].sum() / counts.sum(),
    }
    for i, part in enumerate(PARTS):
        if counts[i].any():
            row[f"{part}_recall"] = counts[i, i + 1] / counts[i].sum()
            row[f"{part}_precision"] = counts[i, i + 1] / max(counts[:, i + 1].sum(), 1.0)
    return {key: round(float(value), 4) for key, value in row.items()} | {"cpu_s": round(seconds, 2)}
